"""An open video: any frame by its number, and which frames are damaged. The last videos of a process stay open.

A frame's number is the count of frames before it. A container's index and frame rate may disagree, so a seek is trusted only within frames that were
decoded before: it must arrive at the time recorded for that frame, else decoding restarts from the beginning.

In most codecs a frame builds on those before it, so damage lasts until the next key frame. If a frame was dropped, later ones may be counted wrongly,
and the damage lasts until the end; unless all are key frames, and the file has as many as it states.
"""

import os
import threading
from collections import OrderedDict
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from bayes_body.base.errors import input_error
from bayes_body.base.files.read import NoSuchFileError, open_regular
from bayes_body.recording.readers.videos.stream import DROPPED, LARGEST_BYTES, Outcome, VideoStream, open_video, picture_of

# Within this many frames, decode instead of seeking, since a seek starts at a key frame, often a hundred frames before its target.
NEAR = 50
OPEN_AT_ONCE = 32


class VideoReader:
    """An open video. The frames decoded so far have a time and a state each; frames are numbered from 0, in the order of display."""

    def __init__(self, path: Path):
        self.lock = threading.Lock()
        self._path = path
        self._stream, self._options = open_video(path)
        self.stated_frames = self._stream.stated_frames
        self._times: list[int | None] = []
        self._damaged: list[bool] = []
        # Whether all frames are decoded; how many there are, where those after a dropped one cannot be numbered.
        self._ended, self._unnumbered = False, 0
        self._spoiled = False
        # The number of the frame that the stream decodes next.
        self._next = 0
        # The frame before `_next`: a look for damage decodes a frame before it is read.
        self._decoded: tuple[int, Outcome] | None = None
        # The picture that was read last: images and silhouettes both read it.
        self._last: tuple[int, NDArray[np.uint8]] | None = None

    @property
    def count_known(self) -> int:
        """How many frames were decoded so far."""
        return len(self._times) + self._unnumbered

    def count(self) -> int:
        """How many frames can be decoded."""
        while not self._ended:
            self._explore()
        return self.count_known

    def is_damaged(self, number: int) -> bool:
        """Whether a frame is damaged; False beyond the end of a sound video."""
        while number >= len(self._damaged) and not self._ended:
            self._explore()
        return self._damaged[number] if number < len(self._damaged) else self._unnumbered > 0

    def read(self, number: int) -> NDArray[np.uint8] | None:
        """A frame, or None if it cannot be decoded."""
        if self._last is None or self._last[0] != number:
            outcome = self._decoded[1] if self._decoded is not None and self._decoded[0] == number else self._reach(number)
            if outcome is None or outcome.frame is None:
                return None
            self._last = number, picture_of(outcome.frame)
        return self._last[1].copy()

    def leads_to(self, number: int) -> bool:
        """Whether a seek to this frame succeeds, for a frame that the container's header counts."""
        if not 0 <= number < self.stated_frames:
            return False
        time = self._stream.time_of(number)
        # Half a frame early: the time is rounded.
        half = (time - self._stream.time_of(number - 1)) // 2 if number else 0
        arrives = self._stream.seek(time) and any(
            outcome.frame is not None and outcome.time is not None and outcome.time >= time - half for outcome in self._stream.outcomes
        )
        self._restart()
        return arrives

    def close(self) -> None:
        """Close the file."""
        self._stream.close()

    def _explore(self) -> None:
        """Decode the next frame that was never decoded, or notice the end."""
        if self._next > len(self._times):
            self._restart()
        while self._next < len(self._times):
            self._advance()
        self._advance()

    def _advance(self) -> Outcome | None:
        """Decode the next frame; None at the end, and where frames can no longer be numbered."""
        outcome = next(self._stream.outcomes, None)
        if self._next == len(self._times) and not self._ended:
            if outcome is None:
                self._ended = True
            elif outcome.frame is None:
                self._decode_the_rest()
                return None
            else:
                self._spoiled = not outcome.sound or (self._spoiled and not outcome.key)
                self._times.append(outcome.time)
                self._damaged.append(self._spoiled)
        self._decoded = None if outcome is None else (self._next, outcome)
        self._next += outcome is not None
        return outcome

    def _decode_the_rest(self) -> None:
        """A frame was dropped: decide whether those after it can be numbered. The video is at its beginning afterwards."""
        outcomes = [DROPPED, *(outcome.without_picture() for outcome in self._stream.outcomes)]
        numbered = len(outcomes) == 1 or len(self._times) + len(outcomes) == self.stated_frames
        if numbered and all(outcome.key or outcome.dropped for outcome in outcomes):
            self._damaged += [not outcome.sound for outcome in outcomes]
            self._times += [outcome.time for outcome in outcomes]
        else:
            self._unnumbered = len(outcomes)
        self._ended = True
        self._restart()

    def _reach(self, number: int) -> Outcome | None:
        """Decode a frame; None beyond the end."""
        if self._ended and number >= len(self._times):
            return None
        if not self._next <= number <= self._next + NEAR:
            outcome = self._jump(number)
            if outcome is not None:
                return outcome
        outcome = None
        while self._next <= number:
            outcome = self._advance()
            if outcome is None:
                return None
        return outcome

    def _jump(self, number: int) -> Outcome | None:
        """Decode a frame by the container's index. If that does not lead to it: None, and the video is at its beginning if the frame lies behind."""
        time = self._times[number] if number < len(self._times) else None
        if time is not None and self._is_distinct(number):
            if self._stream.seek(time):
                for outcome in self._stream.outcomes:
                    if outcome.time is None or outcome.time > time:
                        break
                    if outcome.time == time:
                        self._next, self._decoded = number + 1, None
                        return outcome
            self._restart()
        elif number < self._next:
            self._restart()
        return None

    def _is_distinct(self, number: int) -> bool:
        """Whether a frame's time is unlike its neighbours': in streams without times all are the same."""
        times = self._times[max(0, number - 1) : number + 2]
        return all(earlier is not None and next_time is not None and earlier < next_time for earlier, next_time in pairwise(times))

    def _restart(self) -> None:
        self._stream.close()
        self._stream, self._next, self._decoded = VideoStream(self._path, self._options), 0, None


_readers: OrderedDict[tuple[int, str, int, int], VideoReader] = OrderedDict()
_readers_lock = threading.Lock()


@contextmanager
def reading(path: Path) -> Iterator[VideoReader]:
    """The open video of a path, for one thread at a time."""
    # A forked child shares its parent's file position, and a file may be rewritten under the same name.
    key = (os.getpid(), str(path), *file_state(path))
    with _readers_lock:
        reader = _readers.pop(key, None) or VideoReader(path)
        _readers[key] = reader
        if len(_readers) > OPEN_AT_ONCE:
            _readers.popitem(last=False)
    with reader.lock:
        yield reader


def file_state(path: Path) -> tuple[int, int]:
    """The time of a video's last change, ns, and its size in bytes."""
    try:
        with open_regular(path, "a video", LARGEST_BYTES) as file:
            state = os.fstat(file.fileno())
    except NoSuchFileError:
        raise input_error(path, "no such file", "a video", "restore it, or correct the camera's video in session.toml") from None
    return state.st_mtime_ns, state.st_size
