"""Find frames of a video that cannot be trusted: a decoder that meets damaged bytes repairs or drops frames, and OpenCV does not say so.

The video is decoded once more, with PyAV, which reports it. In most codecs a frame builds on those before it, so damage lasts until the next key
frame. If a frame was dropped, later ones may be counted wrongly, and the damage lasts until the end; unless all are key frames, and the file has as
many as it states.
"""

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from bayes_body.files.read import open_regular

if TYPE_CHECKING:
    from av import Packet

LARGEST_BYTES = 2**44


class Outcome(NamedTuple):
    """What became of a frame: whether it is sound, whether it is a key frame, and whether the decoder dropped it."""

    sound: bool
    key: bool
    dropped: bool


DROPPED = Outcome(False, False, True)


class Damage:
    """Which frames of a video are damaged, found by decoding as far as asked. Frames are numbered from 0, in the order of display."""

    def __init__(self, path: Path):
        self._path, self._outcomes = path, _outcomes(path)
        self._damaged = list[bool]()
        # From here on all frames are damaged.
        self._end: int | None = None
        self._spoiled = False

    def of(self, number: int) -> bool:
        """Whether a frame is damaged; False beyond the end of a sound video."""
        while number >= len(self._damaged) and self._end is None:
            outcome = next(self._outcomes, None)
            if outcome is None:
                return False
            if outcome.dropped:
                self._decode_the_rest()
            else:
                self._spoiled = not outcome.sound or (self._spoiled and not outcome.key)
                self._damaged.append(self._spoiled)
        return self._damaged[number] if number < len(self._damaged) else self._end is not None

    def _decode_the_rest(self) -> None:
        """A frame was dropped: decide whether those after it can be counted."""
        rest = [DROPPED, *self._outcomes]
        counted = len(rest) == 1 or len(self._damaged) + len(rest) == _stated_frames(self._path)
        if counted and all(outcome.key or outcome.dropped for outcome in rest):
            self._damaged += [not outcome.sound for outcome in rest]
        else:
            self._end = len(self._damaged)


def _outcomes(path: Path) -> Iterator[Outcome]:
    """What became of each frame."""
    # Some cameras write streams that a strict decoder refuses from the first frame on. There, only what the usual decoder reports is damage.
    strict = _decoded(path, {"err_detect": "explode"})
    first = next(strict, None)
    if first is None or first.dropped:
        yield from _decoded(path, {})
    else:
        yield first
        yield from strict


def _stated_frames(path: Path) -> int:
    import av

    with open_regular(path, "a video", LARGEST_BYTES) as file, av.open(file, mode="r") as container:
        stream = container.streams.best("video")
        return stream.frames if isinstance(stream, av.VideoStream) else 0


def _decoded(path: Path, options: dict[str, str]) -> Iterator[Outcome]:
    import av
    from av.error import FFmpegError

    with open_regular(path, "a video", LARGEST_BYTES) as file:
        try:
            container = av.open(file, mode="r")
        except FFmpegError:
            # OpenCV opened it, and is asked for its frames: there is nothing to compare them with.
            return
        with container:
            stream = container.streams.best("video")
            if not isinstance(stream, av.VideoStream):
                return
            stream.codec_context.options = options
            # One thread: with several, some decoders hide errors, and what is reported depends on chance.
            stream.thread_type, stream.codec_context.thread_count = "NONE", 1
            try:
                for packet in container.demux(stream):
                    yield from _frames(packet)
            except FFmpegError:
                # The container is damaged from here on.
                yield DROPPED


def _frames(packet: "Packet") -> Iterator[Outcome]:
    import av
    from av.error import FFmpegError

    try:
        frames = [frame for frame in packet.decode() if isinstance(frame, av.VideoFrame)]
    except FFmpegError:
        yield DROPPED
        return
    yield from (Outcome(not frame.is_corrupt, bool(frame.key_frame), False) for frame in frames)
