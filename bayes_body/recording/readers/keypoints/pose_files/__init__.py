"""Keypoints of other programs that write one file for a whole video: AlphaPose, MMPose, DeepLabCut, SLEAP."""
