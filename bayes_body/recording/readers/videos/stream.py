"""Decode a video from its beginning or from a time, with PyAV: what became of each frame, in the order of display.

A decoder that meets damaged bytes repairs or drops frames. PyAV reports both.
"""

from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import av
import numpy as np
from av.error import FFmpegError
from jaxtyping import Float
from numpy.typing import NDArray

from bayes_body.base.errors import input_error
from bayes_body.base.files.read import open_regular

LARGEST_BYTES = 2**44
# Colours as all programs read them that ignore a file's colour tags, OpenCV among them.
BGR = {"format": "bgr24", "src_colorspace": "ITU601", "dst_colorspace": "ITU601", "threads": 1}
# Some cameras write streams that a strict decoder refuses from the first frame on. There, only what the usual decoder reports is damage.
STRICT, USUAL = {"err_detect": "explode"}, {}


class Outcome(NamedTuple):
    """What became of a frame.

    Attributes:
        frame: as decoded; None if the decoder dropped it.
        sound: whether the decoder met no error in it.
        key: whether it depends on no other frame.
        time: its time of presentation, in units of the stream; None if the stream has none.
        dropped: whether the decoder dropped it.
    """

    frame: av.VideoFrame | None
    sound: bool
    key: bool
    time: int | None
    dropped: bool = False

    def without_picture(self) -> "Outcome":
        """The same, with the memory of its picture given back."""
        return self._replace(frame=None)


class Stamps(NamedTuple):
    """What a video's file says about time.

    Attributes:
        times_s: the times of presentation of its frames, seconds, ascending; empty if it has none.
        unit_s: their resolution, seconds.
        fps: frames per second by the header; 0 if it does not state them.
        average_fps: frames over duration by the header; 0 if it does not state them.
        frames: the number of frames by the header, less those that are not presented; at least as many as there are times.
    """

    times_s: Float[np.ndarray, " frame"]
    unit_s: float
    fps: float
    average_fps: float
    frames: int


DROPPED = Outcome(None, False, False, None, dropped=True)


class VideoStream:
    """An open video, and the frames that follow the place where it is.

    Args:
        path: the file.
        options: of the decoder: STRICT or USUAL.

    Raises:
        InputError: not a video that can be read.
    """

    def __init__(self, path: Path, options: dict[str, str]):
        self._file = open_regular(path, "a video", LARGEST_BYTES)
        try:
            self._container = av.open(self._file, mode="r")
            stream = self._container.streams.best("video")
        except (FFmpegError, ValueError):
            stream = None
        if not isinstance(stream, av.VideoStream):
            self._file.close()
            raise input_error(
                path,
                "not a video that FFmpeg can read, or cut short",
                "a whole mp4, avi, mov or mkv",
                "copy the file again, or convert it to mp4 (H.264)",
            )
        stream.codec_context.options = options
        # One thread: with several, some decoders hide errors, and what is reported depends on chance.
        stream.thread_type, stream.codec_context.thread_count = "NONE", 1
        self._stream = stream
        self.outcomes = self._decoded()

    @property
    def fps(self) -> float:
        """Frames per second; 0 if the file does not state it."""
        return float(self._stream.guessed_rate or self._stream.average_rate or 0)

    @property
    def stated_frames(self) -> int:
        """The number of frames in the container's header, else from its duration; 0 if it has neither."""
        stream = self._stream
        if stream.frames:
            return stream.frames
        if stream.duration and stream.time_base:
            return round(float(stream.duration * stream.time_base) * self.fps)
        return round((self._container.duration or 0) / av.time_base * self.fps)

    def time_of(self, number: int) -> int:
        """The time of a frame if all frames are equally far apart."""
        if not self.fps or not self._stream.time_base:
            return 0
        return (self._stream.start_time or 0) + round(number / self.fps / float(self._stream.time_base))

    def seek(self, time: int) -> bool:
        """Go on at the key frame before a time; False if the container cannot."""
        try:
            self._container.seek(max(time, 0), stream=self._stream)
        except FFmpegError:
            return False
        self.outcomes = self._decoded()
        return True

    def stamps(self) -> Stamps:
        """The times of presentation, by a pass over the packets. The stream is at its end afterwards."""
        shown, hidden = list[int | None](), 0
        try:
            for packet in self._container.demux(self._stream):
                # An edit list hides packets that only serve to decode others. The last packet, and a frame that repeats the one before, are empty.
                if packet.size and packet.is_discard:
                    hidden += 1
                elif packet.size:
                    shown.append(packet.pts if packet.pts is not None else packet.dts)
        except FFmpegError:
            # The container is damaged from here on.
            pass
        unit, average_fps = float(self._stream.time_base or 0), float(self._stream.average_rate or 0)
        times = [] if None in shown else sorted(time for time in shown if time is not None)
        frames = max(len(shown), self.stated_frames - hidden)
        return Stamps(unit * np.array(times, float), unit, self.fps, average_fps, frames)

    def close(self) -> None:
        """Close the file."""
        self._container.close()
        self._file.close()

    def _decoded(self) -> Iterator[Outcome]:
        try:
            for packet in self._container.demux(self._stream):
                try:
                    frames = packet.decode()
                except FFmpegError:
                    yield DROPPED
                    continue
                for frame in frames:
                    if isinstance(frame, av.VideoFrame):
                        yield Outcome(frame, not frame.is_corrupt, bool(frame.key_frame), frame.pts)
        except FFmpegError:
            # The container is damaged from here on.
            yield DROPPED


def open_video(path: Path) -> tuple[VideoStream, dict[str, str]]:
    """Open a video at its beginning, and say with which options.

    Raises:
        InputError: not a video that can be read.
    """
    stream = VideoStream(path, STRICT)
    first = next(stream.outcomes, DROPPED)
    stream.close()
    options = USUAL if first.frame is None else STRICT
    return VideoStream(path, options), options


def read_stamps(path: Path) -> Stamps:
    """What a video's file says about time. No picture is decoded.

    Raises:
        InputError: not a video that can be read.
    """
    stream = VideoStream(path, USUAL)
    try:
        return stream.stamps()
    finally:
        stream.close()


def picture_of(frame: av.VideoFrame) -> NDArray[np.uint8]:
    """Return a frame as blue, green, red (row, column, 3), upright as players show it."""
    picture = frame.to_ndarray(**BGR)
    return np.ascontiguousarray(np.rot90(picture, round(frame.rotation / 90) % 4), np.uint8)
