"""A whole run on disk: track, summarise, draw."""
