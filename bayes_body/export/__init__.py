"""A run's motion in the formats of other programs, with its uncertainty where the format has room for it."""
