"""Find frames of a video that cannot be trusted: a decoder that meets damaged bytes repairs or drops frames, and OpenCV does not say so.

The video is decoded once more, with PyAV, which reports it. In most codecs a frame builds on those before it, so damage lasts until the next key
frame; if a frame was dropped, later ones cannot be counted, and the damage lasts until the end. A codec of key frames only loses single frames.
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
        self._damaged: list[bool] = []
        self._outcomes = _outcomes(path)
        self._spoiled = self._dropped = False
        self._only_keys = True

    def of(self, number: int) -> bool:
        """Whether a frame is damaged; False beyond the end of a sound video."""
        while number >= len(self._damaged):
            outcome = next(self._outcomes, None)
            if outcome is None:
                # OpenCV may count frames here that PyAV dropped.
                return self._dropped and not self._only_keys
            self._add(outcome)
        return self._damaged[number]

    def _add(self, outcome: Outcome) -> None:
        self._dropped |= outcome.dropped
        self._only_keys &= outcome.key or outcome.dropped
        if not outcome.sound:
            self._spoiled = True
        elif self._only_keys or (outcome.key and not self._dropped):
            self._spoiled = False
        self._damaged.append(self._spoiled)


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
