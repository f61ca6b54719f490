"""Definitions (TOML), and models, which are built from a definition and a session."""
