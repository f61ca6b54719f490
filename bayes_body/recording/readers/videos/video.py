"""Read videos: any frame by its number, with the same bits whether it is reached by reading on or by seeking, and which frames are damaged."""

from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from bayes_body.base.errors import input_error
from bayes_body.recording.readers.images import check_size, not_seen
from bayes_body.recording.readers.videos.clock import VideoClock, video_clock
from bayes_body.recording.readers.videos.reader import OPEN_AT_ONCE, VideoReader, file_state, reading


class VideoInfo(NamedTuple):
    """Properties of a video.

    Attributes:
        size_px: (width, height), upright as displayed.
        fps: frames per second by the timestamps (`video_clock`); 0 if the file does not tell it.
        frames: the number of frames in the container's header, less those that players do not show, or the number that can be decoded if the header
            has none.
    """

    size_px: tuple[int, int]
    fps: float
    frames: int


def probe(path: Path) -> VideoInfo:
    """Size, rate and length of a video. Its first frame is decoded, and all timestamps are read.

    Raises:
        InputError: missing, not a video that FFmpeg can read, or without frames.
    """
    with reading(path) as reader:
        image = reader.read(0)
        if image is None:
            raise input_error(
                path, "a video without a frame that can be decoded", "at least one", "copy the file again, or convert it to mp4 (H.264)"
            )
        clock = read_clock(path)
        return VideoInfo((image.shape[1], image.shape[0]), clock.fps, len(clock.times_s) or reader.count())


def read_clock(path: Path) -> VideoClock:
    """When the frames of a video were filmed, by its timestamps. No picture is decoded; the clocks of the last videos stay in memory.

    Raises:
        InputError: missing, not a video, or timestamps that span more than a million frames.
    """
    return video_clock(path, file_state(path))


def read_video_frame(path: Path, number: int, size_px: tuple[int, int] | None = None) -> NDArray[np.uint8]:
    """Frame `number`, counted from 0, of a video: blue, green, red, (row, column, 3).

    The last 32 videos of a process stay open. May be called from any thread.

    Args:
        path: the file, in any format that FFmpeg reads.
        number: which frame.
        size_px: the required (width, height); None accepts any.

    Raises:
        NotSeenError: the frame is damaged, or the video ends, or cannot be decoded, before it.
        InputError: missing, not a video, a negative number, or another size.
    """
    _check_number(path, number)
    with reading(path) as reader:
        if reader.is_damaged(number):
            raise not_seen(path, f"frame {number} is damaged", "a frame that can be decoded without errors", "copy the file again")
        image, end = reader.read(number), reader.count_known
    if image is None:
        problem, expected = f"frame {number} cannot be read, the video ends after {end} frames", f"more than {number}"
        raise not_seen(path, problem, expected, "copy the file again, or correct first_frame and frames in session.toml")
    check_size(path, (image.shape[1], image.shape[0]), size_px)
    return image


def readable_frames(path: Path, frames: int) -> int:
    """How many of the first `frames` frames of a video can be decoded. Fast if all can; otherwise the video is decoded to its end.

    Raises:
        InputError: missing, or not a video.
    """
    if frames <= _sound_length(path, file_state(path)):
        return frames
    with reading(path) as reader:
        return min(frames, reader.count())


def has_video_frame(path: Path, number: int) -> bool:
    """Whether a video is long enough to have frame `number`, counted from 0. Such a frame is not decoded: whether it is damaged is not known.

    Raises:
        InputError: missing, not a video, or a negative number.
    """
    _check_number(path, number)
    return readable_frames(path, number + 1) > number


@lru_cache(OPEN_AT_ONCE)
def _sound_length(path: Path, state: tuple[int, int]) -> int:
    """The number of frames in a container's header, if a seek leads to the last of them; else 0. `state` is there for the cache."""
    del state
    reader = VideoReader(path)
    try:
        return reader.stated_frames if reader.leads_to(reader.stated_frames - 1) else 0
    finally:
        reader.close()


def damaged_frames(path: Path, numbers: Sequence[int]) -> list[int]:
    """Which of these frames are damaged. The video is decoded up to the last of them.

    Raises:
        InputError: missing, or not a video.
    """
    with reading(path) as reader:
        return [number for number in numbers if reader.is_damaged(number)]


def _check_number(path: Path, number: int) -> None:
    if number < 0:
        raise input_error(path, f"frame {number}", "0 or later", "correct first_frame and the camera's offset in session.toml")
