"""What every room stands on: errors, shapes, the registry, settings, progress; files, TOML and geometry."""
