"""Read and check TOML files, and report their faults as sentences."""
