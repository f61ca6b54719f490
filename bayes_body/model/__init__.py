"""Definitions (TOML), and the model that a definition and a session make."""
