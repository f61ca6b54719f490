"""A run's folder: one file for each frame, the settings, and a finished run loaded from its folder."""

from bayes_body.results.storage.frame_files import FrameFiles

__all__ = ["FrameFiles"]
