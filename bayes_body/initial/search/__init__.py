"""Search for a person in pictures, without any first pose."""
