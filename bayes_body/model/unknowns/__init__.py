"""What is not known exactly and hardly moves: lengths and widths of the body, cameras, clocks, and where keypoints lie."""
