"""Videos: their pictures, their clocks, and which frames belong together."""
