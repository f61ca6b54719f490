"""Export of a run's motion to the formats of other programs, with its uncertainty if the format can store it."""
