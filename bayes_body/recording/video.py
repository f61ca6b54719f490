"""Videos, through OpenCV: any frame by its number, the same bits whether it is reached by reading on or by a jump.

A frame's number is how many the decoder gives before it. A container's index and frame rate may say something else, so a jump is only trusted where
the timestamps were seen before: it goes to a frame that was passed already and must arrive at that frame's own time, else decoding starts anew.
"""

import os
import threading
from collections import OrderedDict
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from bayes_body.errors import input_error
from bayes_body.recording.images import check_size, not_seen, silent

# FFmpeg's own complaints say nothing that the error which follows does not; read when OpenCV opens its first video.
os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")
# Up to so many frames ahead are decoded rather than jumped to: a jump starts at a key frame, often a hundred frames before its aim.
NEAR = 50
OPEN_AT_ONCE = 32


class VideoInfo(NamedTuple):
    """What a video is.

    Attributes:
        size_px: (width, height), upright as it is shown.
        fps: frames a second; 0 where the file does not say.
        frames: how many its container names, or, where it names none, how many can be decoded.
    """

    size_px: tuple[int, int]
    fps: float
    frames: int


def probe(path: Path) -> VideoInfo:
    """Size, rate and length of a video, whose first frame is decoded.

    Raises:
        InputError: missing, no video that OpenCV can read, or without frames.
    """
    with _reading(path) as reader:
        image = reader.read(0)
        if image is None:
            raise input_error(
                path, "a video without a frame that can be decoded", "at least one", "copy the file again, or convert it to mp4 (H.264)"
            )
        named = reader.property(cv2.CAP_PROP_FRAME_COUNT)
        rate = reader.property(cv2.CAP_PROP_FPS)
        frames = int(named) if named >= 1 else reader.count()
    return VideoInfo((image.shape[1], image.shape[0]), rate if np.isfinite(rate) and rate > 0 else 0.0, frames)


def read_video_frame(path: Path, number: int, size_px: tuple[int, int] | None = None) -> NDArray[np.uint8]:
    """Frame `number`, counted from 0, of a video: blue, green, red, (row, column, 3).

    Videos stay open, the last 32 of a process. May be called from any thread.

    Args:
        path: the file, of any format that OpenCV's FFmpeg reads.
        number: which frame.
        size_px: the (width, height) that it must have; None takes any.

    Raises:
        NotSeenError: the video ends, or can be decoded, only so far.
        InputError: missing, no video, a negative number, or of another size.
    """
    if number < 0:
        raise input_error(path, f"frame {number}", "0 or later", "correct first_frame and the camera's offset in session.toml")
    with _reading(path) as reader:
        image, end = reader.read(number), reader.end
    if image is None:
        found, expected = f"frame {number} cannot be read, the video ends after {end} frames", f"more than {number}"
        raise not_seen(path, found, expected, "copy the file again, or correct first_frame and frames in session.toml")
    check_size(path, (image.shape[1], image.shape[0]), size_px)
    return image


def readable_frames(path: Path, frames: int) -> int:
    """How many of the first `frames` frames of a video can be decoded; fast where all can, else it is decoded to its end.

    Raises:
        InputError: missing, or no video.
    """
    with _reading(path) as reader:
        return frames if reader.leads_to(frames - 1) else min(frames, reader.count())


class _Reader:
    """An open video and the times of the frames that it has passed."""

    def __init__(self, path: Path):
        self.lock = threading.Lock()
        self.end: int | None = None
        self._path = path
        self._times: list[float] = []
        self._next = 0
        # The frame before `_next`, once it was asked for: pictures and silhouettes read the same one.
        self._last: NDArray[np.uint8] | None = None
        self._capture = self._open()

    def _open(self) -> cv2.VideoCapture:
        with silent():
            capture = cv2.VideoCapture(str(self._path), cv2.CAP_FFMPEG)
        if not capture.isOpened():
            found = "no video that OpenCV can read, or cut short"
            raise input_error(self._path, found, "a whole mp4, avi, mov or mkv", "copy the file again, or convert it to mp4 (H.264)")
        self._next, self._last = 0, None
        return capture

    def property(self, which: int) -> float:
        """One of OpenCV's CAP_PROP values."""
        return float(self._capture.get(which))

    def read(self, number: int) -> NDArray[np.uint8] | None:
        """A frame, or None beyond the end."""
        if self._last is None or self._next != number + 1:
            if not self._reach(number):
                return None
            decoded, image = self._capture.retrieve()
            if not decoded:
                self.end = number
                return None
            self._last = np.asarray(image, np.uint8)
        return self._last.copy()

    def count(self) -> int:
        """How many frames can be decoded."""
        while self.end is None:
            self._reach(len(self._times))
        return self.end

    def leads_to(self, number: int) -> bool:
        """Whether a frame that the container names can be decoded, by a jump; afterwards the video is at its beginning."""
        if number < len(self._times):
            return True
        if self.end is not None or number >= self.property(cv2.CAP_PROP_FRAME_COUNT):
            return False
        self._capture.set(cv2.CAP_PROP_POS_FRAMES, number)
        found = self._capture.grab()
        self._reopen()
        return found

    def _reach(self, number: int) -> bool:
        """Grab frame `number`; False beyond the end."""
        if self.end is not None and number >= self.end:
            return False
        self._last = None
        if not self._next <= number <= self._next + NEAR:
            jumped = self._known(number) and self._jump(number)
            if not jumped and number < self._next:
                self._reopen()
        while self._next <= number:
            if not self._grab():
                return False
        return True

    def _grab(self) -> bool:
        if not self._capture.grab():
            self.end = self._next
            return False
        if self._next == len(self._times):
            self._times.append(self.property(cv2.CAP_PROP_POS_MSEC))
        self._next += 1
        return True

    def _known(self, number: int) -> bool:
        """Whether a frame's time was seen and is its own: streams without timestamps give all frames the same."""
        around = self._times[max(0, number - 1) : number + 2]
        return number < len(self._times) and all(a < b for a, b in pairwise(around))

    def _jump(self, number: int) -> bool:
        """Grab a frame by the container's index; False, and back at the beginning, if it arrives elsewhere."""
        self._capture.set(cv2.CAP_PROP_POS_FRAMES, number)
        if self._capture.grab() and self.property(cv2.CAP_PROP_POS_MSEC) == self._times[number]:
            self._next = number + 1
            return True
        self._reopen()
        return False

    def _reopen(self) -> None:
        self._capture.release()
        self._capture = self._open()


_readers: OrderedDict[tuple[int, str, int, int], _Reader] = OrderedDict()
_readers_lock = threading.Lock()


@contextmanager
def _reading(path: Path) -> Iterator[_Reader]:
    """The open video of a path, for one thread at a time."""
    try:
        state = path.stat()
    except OSError as error:
        found = "no such file" if isinstance(error, FileNotFoundError) else f"cannot be read ({error.strerror})"
        raise input_error(path, found, "a video", "restore it, or correct the camera's video in session.toml") from None
    # A child of a fork shares its parent's place in the file, and a file may be written anew under the same name.
    key = (os.getpid(), str(path), state.st_mtime_ns, state.st_size)
    with _readers_lock:
        reader = _readers.pop(key, None) or _Reader(path)
        _readers[key] = reader
        if len(_readers) > OPEN_AT_ONCE:
            _readers.popitem(last=False)
    with reader.lock:
        yield reader
