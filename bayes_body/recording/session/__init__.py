"""A recording: its plain data, its file and its schema."""
