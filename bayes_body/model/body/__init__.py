"""Bodies: joints, solids, and the schema of a body file."""
