"""What a recording is: plain data, its file, its schema."""
