"""Plugins: a user's own terms, loaded from a file and checked before a run."""
