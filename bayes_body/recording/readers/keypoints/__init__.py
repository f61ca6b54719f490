"""Keypoints of networks: their files, their order and unit, and the person whom they show."""
