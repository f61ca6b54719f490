"""Write and read files: completely or not at all, locked, with errors that a user understands."""
