"""What is learned from captured motion or from images, as small arrays that ship with the command that learns them again."""
