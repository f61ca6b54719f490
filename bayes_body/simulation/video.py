"""Writing videos (MPEG-4 in .mp4, which any OpenCV can write) and numbered silhouettes; what cannot be written is said as a sentence."""

from pathlib import Path
from types import TracebackType
from typing import Self

import cv2
import numpy as np
from jaxtyping import Bool, UInt8

from bayes_body.errors import InputError, input_error
from bayes_body.files.atomic import make_folder
from bayes_body.recording.images import silent

CODEC = "mp4v"


class VideoWriter:
    """A video that is written frame by frame, and whole once it is closed."""

    def __init__(self, path: Path, fps: float, size_px: tuple[int, int]):
        """Open a video.

        Args:
            path: its file; the folder is made if need be.
            fps: frames a second.
            size_px: (width, height).

        Raises:
            InputError: it cannot be written.
        """
        make_folder(path.parent)
        with silent():
            self._video = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*CODEC), fps, size_px)
        self._path = path
        if not self._video.isOpened():
            raise _refused(path, "cannot be opened for writing")

    def add(self, picture: UInt8[np.ndarray, "row column 3"]) -> None:
        """Write the next frame: blue, green, red."""
        self._video.write(picture)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        """Close the file; OpenCV tells of a full disk only by what is not there."""
        self._video.release()
        if error is None and not (self._path.is_file() and self._path.stat().st_size):
            raise _refused(self._path, "is empty")


def write_mask(pattern: Path, number: int, mask: Bool[np.ndarray, "row column"]) -> None:
    """Write a silhouette, white where the person is.

    Args:
        pattern: of the file's name, with one place for the number; its folder is there.
        number: the frame's.
        mask: the silhouette.

    Raises:
        InputError: it cannot be written.
    """
    path = Path(str(pattern) % number)
    if not cv2.imwrite(str(path), mask.astype(np.uint8) * 255):
        raise _refused(path, "cannot be written")


def _refused(path: Path, found: str) -> InputError:
    return input_error(path, found, "a folder that can be written, with room", "name another folder, or free some space")
