"""A study at a glance: a page with a row for each session, and the same figures as a table for other programs. Nothing here loads JAX."""
