"""A recording: its plain data, the readers of its files, and what is seen in its pictures."""
