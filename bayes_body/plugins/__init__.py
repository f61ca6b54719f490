"""A user's own terms: loaded from a file, checked before a run."""
