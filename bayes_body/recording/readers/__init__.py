"""Read recordings: calibrations, images, videos, keypoints, motion capture and true markers."""
