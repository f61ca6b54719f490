"""A run's folder: one file for each frame, the settings, and a finished run loaded from its folder."""

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from bayes_body.results.storage.frame_files import FrameFiles

__all__ = ["FrameFiles"]


def __getattr__(name: str) -> Any:
    # The driver of a study needs the names of files, and must not load JAX for them.
    if name != "FrameFiles":
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from bayes_body.results.storage.frame_files import FrameFiles

    return FrameFiles
