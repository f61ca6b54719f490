"""Bodies: joints, solids, and what a body file may say."""
