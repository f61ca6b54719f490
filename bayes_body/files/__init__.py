"""How files are written and read: whole or not at all, locked, with errors that a user understands."""
