"""Learn from captured motion or from images. The results are small arrays that ship with the package."""
