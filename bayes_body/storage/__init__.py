"""A run's folder while it is made: a file a frame, the settings, and the lock that keeps a second process out."""

from bayes_body.storage.frame_files import FrameFiles

__all__ = ["FrameFiles"]
