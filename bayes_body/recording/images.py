"""Image files as grey values and silhouettes, through OpenCV; a file that is missing, cut short or of the wrong size is a sentence, not a crash."""

import struct
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from bayes_body.errors import InputError, input_error

# Above it a grey value of a silhouette image belongs to the subject.
MASK_THRESHOLD = 127
# OpenCV's log level belongs to the whole process: two threads that each put it back could leave it silent for good.
_LOG_LEVEL = threading.Lock()


class NotSeenError(InputError):
    """A camera has no picture of a frame: the file is missing, cut short or no image. Whoever follows the recording may go on without it."""


def read_grey(path: Path, size_px: tuple[int, int] | None = None) -> NDArray[np.uint8]:
    """An image's grey values, (height, width), 0 to 255; colours are weighted as OpenCV does.

    Args:
        path: the file, of any format that OpenCV reads.
        size_px: the (width, height) that it must have; None takes any.

    Raises:
        NotSeenError: missing, cut short, or no image.
        InputError: it may not be read, or is of another size.
    """
    return _read(path, size_px, cv2.IMREAD_GRAYSCALE)


def read_colour(path: Path, size_px: tuple[int, int] | None = None) -> NDArray[np.uint8]:
    """An image's blue, green and red, (height, width, 3), 0 to 255. Arguments and errors are those of `read_grey`."""
    return _read(path, size_px, cv2.IMREAD_COLOR)


def read_mask(path: Path, size_px: tuple[int, int] | None = None) -> NDArray[np.bool_]:
    """A silhouette, (height, width): true where the image is brighter than 127. Arguments and errors are those of `read_grey`."""
    return read_grey(path, size_px) > MASK_THRESHOLD


def is_image(path: Path) -> bool:
    """Whether OpenCV takes a file for an image, rather than for a video or nothing, by its first bytes."""
    return cv2.haveImageReader(str(path))


def check_size(path: Path, found: tuple[int, int], size_px: tuple[int, int] | None) -> None:
    """Refuse pictures that are not of their camera's size, (width, height).

    Raises:
        InputError: they are not.
    """
    if size_px is not None and found != tuple(size_px):
        remedy = "use the images that the camera was calibrated with, or scale focal_px, centre_px and size_px to these"
        raise input_error(path, f"{found[0]} x {found[1]} pixels", f"{size_px[0]} x {size_px[1]} as its camera has", remedy)


def not_seen(path: Path, found: str, expected: str, remedy: str) -> NotSeenError:
    """The error of a frame without a picture, in the words of `bayes_body.errors.wrong`."""
    return NotSeenError(str(input_error(path, found, expected, remedy)))


def _read(path: Path, size_px: tuple[int, int] | None, flag: int) -> NDArray[np.uint8]:
    content = _content(path)
    missing = _missing_bytes(content)
    if missing:
        raise not_seen(path, f"cut short, {missing} of {len(content) + missing} bytes are missing", "a whole image", "copy the file again")
    with silent():
        image = cv2.imdecode(np.frombuffer(content, np.uint8), flag)
    if image is None:
        found = f"no image that OpenCV can read, or cut short ({len(content)} bytes)"
        raise not_seen(path, found, "a whole bmp, png, jpg or tiff", "copy the file again")
    check_size(path, (image.shape[1], image.shape[0]), size_px)
    return np.asarray(image, np.uint8)


def _content(path: Path) -> bytes:
    try:
        content = path.read_bytes()
    except OSError as error:
        raise _unreadable(path, error) from None
    if not content:
        # OpenCV fails an assertion on it.
        raise not_seen(path, "empty", "an image", "copy the file again")
    return content


def _unreadable(path: Path, error: OSError) -> InputError:
    if isinstance(error, FileNotFoundError):
        return not_seen(path, "no such file", "an image", "restore it, or correct the session's image paths, first_frame and frames")
    return input_error(path, f"cannot be read ({error.strerror})", "an image", "check the path and its permissions")


def _missing_bytes(content: bytes) -> int:
    """How many bytes a BMP lacks by its own header; 0 for other formats. Some OpenCVs fill the missing rows silently."""
    if content[:2] != b"BM":
        return 0
    if len(content) < 34:
        return 34 - len(content)
    (whole,) = struct.unpack_from("<I", content, 2)
    start, header, width, height, _, bits, compression = struct.unpack_from("<IIiiHHI", content, 10)
    # Writers are careless with the file size of the header, so it counts only where the rows cannot be counted; rows are padded to 4 bytes.
    if header >= 40 and compression == 0:
        whole = start + (abs(width) * bits + 31) // 32 * 4 * abs(height)
    return max(0, whole - len(content))


@contextmanager
def silent() -> Iterator[None]:
    """Without OpenCV's own complaints on stderr: the error that follows says what they say."""
    with _LOG_LEVEL:
        level = cv2.utils.logging.getLogLevel()
        cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
        try:
            yield
        finally:
            cv2.utils.logging.setLogLevel(level)
