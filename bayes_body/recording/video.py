"""Read videos through OpenCV: any frame by its number, with the same bits whether it is reached by reading on or by seeking.

A frame's number is the count of frames that the decoder returns before it. A container's index and frame rate may disagree, so a seek is trusted only
within frames that were decoded before: it must arrive at the time recorded for that frame, else decoding restarts from the beginning.
"""

import os
import threading
from collections import OrderedDict
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from bayes_body.errors import input_error
from bayes_body.files.read import NoSuchFileError, native_path, open_regular
from bayes_body.recording.images import check_size, not_seen, silent
from bayes_body.recording.video_damage import LARGEST_BYTES, Damage

# FFmpeg's messages add nothing to the error that follows. The variable is read when OpenCV opens its first video.
os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")
# Within this many frames, decode instead of seeking, since a seek starts at a key frame, often a hundred frames before its target.
NEAR = 50
OPEN_AT_ONCE = 32


class VideoInfo(NamedTuple):
    """Properties of a video.

    Attributes:
        size_px: (width, height), upright as displayed.
        fps: frames per second; 0 if the file does not state it.
        frames: the number of frames in the container's header, or the number that can be decoded if the header has none.
    """

    size_px: tuple[int, int]
    fps: float
    frames: int


def probe(path: Path) -> VideoInfo:
    """Size, rate and length of a video. Its first frame is decoded.

    Raises:
        InputError: missing, not a video that OpenCV can read, or without frames.
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

    The last 32 videos of a process stay open. May be called from any thread.

    Args:
        path: the file, in any format that OpenCV's FFmpeg reads.
        number: which frame.
        size_px: the required (width, height); None accepts any.

    Raises:
        NotSeenError: the frame is damaged, or the video ends, or cannot be decoded, before it.
        InputError: missing, not a video, a negative number, or another size.
    """
    if number < 0:
        raise input_error(path, f"frame {number}", "0 or later", "correct first_frame and the camera's offset in session.toml")
    with _reading(path) as reader:
        if reader.damage.of(number):
            raise not_seen(path, f"frame {number} is damaged", "a frame that can be decoded without errors", "copy the file again")
        image, end = reader.read(number), reader.end
    if image is None:
        found, expected = f"frame {number} cannot be read, the video ends after {end} frames", f"more than {number}"
        raise not_seen(path, found, expected, "copy the file again, or correct first_frame and frames in session.toml")
    check_size(path, (image.shape[1], image.shape[0]), size_px)
    return image


def readable_frames(path: Path, frames: int) -> int:
    """How many of the first `frames` frames of a video can be decoded. Fast if all can; otherwise the video is decoded to its end.

    Raises:
        InputError: missing, or not a video.
    """
    with _reading(path) as reader:
        return frames if reader.leads_to(frames - 1) else min(frames, reader.count())


def damaged_frames(path: Path, numbers: Sequence[int]) -> list[int]:
    """Which of these frames are damaged. The video is decoded up to the last of them.

    Raises:
        InputError: missing, or not a video.
    """
    with _reading(path) as reader:
        return [number for number in numbers if reader.damage.of(number)]


class _Reader:
    """An open video and the timestamps of the frames that were decoded so far."""

    def __init__(self, path: Path):
        self.lock = threading.Lock()
        self.end: int | None = None
        self.damage = Damage(path)
        self._path = path
        self._times: list[float] = []
        self._next = 0
        # The frame before `_next`, if it was requested, since images and silhouettes both read it.
        self._last: NDArray[np.uint8] | None = None
        self._capture = self._open()

    def _open(self) -> cv2.VideoCapture:
        with silent():
            capture = cv2.VideoCapture(native_path(self._path), cv2.CAP_FFMPEG)
        if not capture.isOpened():
            found = "not a video that OpenCV can read, or cut short"
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
        """Whether a seek to this frame succeeds, for a frame that the container's header counts. The video is at its beginning afterwards."""
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
        """Whether a frame's timestamp is known and unique: in streams without timestamps all are the same."""
        around = self._times[max(0, number - 1) : number + 2]
        return number < len(self._times) and all(a < b for a, b in pairwise(around))

    def _jump(self, number: int) -> bool:
        """Grab a frame by the container's index. If it arrives elsewhere: False, and the video is at its beginning."""
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
        with open_regular(path, "a video", LARGEST_BYTES) as file:
            state = os.fstat(file.fileno())
    except NoSuchFileError:
        raise input_error(path, "no such file", "a video", "restore it, or correct the camera's video in session.toml") from None
    # A forked child shares its parent's file position, and a file may be rewritten under the same name.
    key = (os.getpid(), str(path), state.st_mtime_ns, state.st_size)
    with _readers_lock:
        reader = _readers.pop(key, None) or _Reader(path)
        _readers[key] = reader
        if len(_readers) > OPEN_AT_ONCE:
            _readers.popitem(last=False)
    with reader.lock:
        yield reader
