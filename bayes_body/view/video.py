"""Write videos that browsers, phones and slides can play: H.264 in .mp4, with colours at half resolution."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
from av.container import OutputContainer
from av.error import ExternalError, FFmpegError
from av.video.stream import VideoStream
from cv2.typing import MatLike

from bayes_body.base.errors import input_error

# Slowest and fastest rate of a video, frames a second. Players show nothing useful outside of them, and far outside encoders fail.
SLOWEST, FASTEST = 0.1, 1000.0
# Options of x264: speed of the encoder, and quality (lower is better; at 18 no difference from the original is visible).
PRESET, QUALITY = "veryfast", 21


@contextmanager
def h264_video(path: Path, fps: float, size_px: tuple[int, int]) -> Iterator[Callable[[MatLike], None]]:
    """Yield a function that writes the next picture (blue, green, red). The video is complete at the end of the block.

    Args:
        path: the video's file.
        fps: frames a second; the video's are those of `playing_rate`.
        size_px: (width, height), both even.

    Raises:
        InputError: the encoder refuses the size, or the file system refuses the file.
    """
    try:
        # The index comes first, so that a browser can play the video while it loads.
        with av.open(str(path), "w", format="mp4", options={"movflags": "faststart"}) as container:
            stream = _stream(container, playing_rate(fps), size_px)

            def write(picture: MatLike) -> None:
                container.mux(stream.encode(av.VideoFrame.from_ndarray(np.asarray(picture, np.uint8), format="bgr24")))

            yield write
            container.mux(stream.encode())
    except ExternalError:
        # The encoder's own error, not one of the file system.
        problem = f"the encoder refuses {size_px[0]} x {size_px[1]} pixels"
        raise input_error(path, problem, "a picture of at most 16384 pixels in width and height", "use fewer cameras, or read posterior.nc") from None
    except FFmpegError as error:
        problem = f"cannot be written as a video ({error.strerror})"
        raise input_error(path, problem, "a folder that can be written, with enough free space", "check its permissions and free space") from None


def _stream(container: OutputContainer, fps: float, size_px: tuple[int, int]) -> VideoStream:
    stream = container.add_stream("libx264", Fraction(fps).limit_denominator(10_000), options={"preset": PRESET, "crf": str(QUALITY)})
    stream.width, stream.height = size_px
    stream.pix_fmt = "yuv420p"
    return stream


def playing_rate(fps: float) -> float:
    """Return the rate at which a video of that rate plays: the nearest one from SLOWEST to FASTEST."""
    return min(max(fps, SLOWEST), FASTEST)
