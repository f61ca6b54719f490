"""TOML files read and checked; what is wrong with them as sentences."""
