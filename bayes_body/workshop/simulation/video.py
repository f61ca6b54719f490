"""Write videos (MPEG-4 in .mp4, which every OpenCV can write) and numbered silhouettes. Failures raise an InputError."""

from pathlib import Path
from types import TracebackType
from typing import Self

import cv2
import numpy as np
from jaxtyping import Bool, UInt8

from bayes_body.base.errors import InputError, input_error
from bayes_body.base.files.atomic import make_folder
from bayes_body.recording.readers.images import silent

CODEC = "mp4v"


class VideoWriter:
    """A video that is written frame by frame; the file is complete after closing."""

    def __init__(self, path: Path, fps: float, size_px: tuple[int, int]):
        """Open a video.

        Args:
            path: its file; the folder is created if needed.
            fps: frames per second.
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
        """Close the file. OpenCV does not report a full disk, so check that the file is not empty."""
        self._video.release()
        if error is None and not (self._path.is_file() and self._path.stat().st_size):
            raise _refused(self._path, "is empty")


def write_mask(pattern: Path, number: int, mask: Bool[np.ndarray, "row column"]) -> None:
    """Write a silhouette, white where the person is.

    Args:
        pattern: pattern of the file's name, with one place for the number; its folder exists.
        number: the frame number.
        mask: the silhouette.

    Raises:
        InputError: it cannot be written.
    """
    path = Path(str(pattern) % number)
    if not cv2.imwrite(str(path), mask.astype(np.uint8) * 255):
        raise _refused(path, "cannot be written")


def _refused(path: Path, problem: str) -> InputError:
    return input_error(path, problem, "a writable folder with free space", "name another folder, or free some space")
