"""A complete run on disk: track, summarise, draw."""
