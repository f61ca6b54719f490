"""Read image files as grey values and silhouettes, through OpenCV. A missing, truncated or wrongly sized file raises an InputError."""

import os
import struct
from pathlib import Path

import cv2
import numpy as np
from cv2.typing import MatLike
from numpy.typing import NDArray

from bayes_body.base.errors import InputError, input_error
from bayes_body.base.files.read import NoSuchFileError, native_path, read_bytes
from bayes_body.base.shared_setting import SharedSetting

# A silhouette pixel that is brighter than this belongs to the subject.
MASK_THRESHOLD = 127
# No image of a camera is larger.
LARGEST_BYTES = 1_000_000_000
# In a `with` block, OpenCV prints no messages on stderr. The error that follows says the same.
SILENT = SharedSetting(cv2.utils.logging.getLogLevel, cv2.utils.logging.setLogLevel, cv2.utils.logging.LOG_LEVEL_SILENT)


class NotSeenError(InputError):
    """A camera has no picture of a frame: the file is missing, truncated or not an image. A tracker may go on without it."""


def read_grey(path: Path, size_px: tuple[int, int] | None = None) -> NDArray[np.uint8]:
    """The grey values of an image, (height, width), 0 to 255. OpenCV's weights convert colours.

    Args:
        path: the file, in any format that OpenCV reads.
        size_px: the required (width, height); None accepts any.

    Raises:
        NotSeenError: missing, truncated, or not an image.
        InputError: not a regular file, not readable, of another size, or of more pixels than any camera has.
    """
    return _read(path, size_px, cv2.IMREAD_GRAYSCALE)


def read_colour(path: Path, size_px: tuple[int, int] | None = None) -> NDArray[np.uint8]:
    """An image's blue, green and red, (height, width, 3), 0 to 255. Arguments and errors are those of `read_grey`."""
    return _read(path, size_px, cv2.IMREAD_COLOR)


def read_mask(path: Path, size_px: tuple[int, int] | None = None) -> NDArray[np.bool_]:
    """A silhouette, (height, width): true where the image is brighter than 127. Arguments and errors are those of `read_grey`."""
    return read_grey(path, size_px) > MASK_THRESHOLD


def is_image(path: Path) -> bool:
    """Whether OpenCV recognises the first bytes of a file as an image. False if it is not a regular file."""
    if not path.is_file():
        return False
    return cv2.haveImageReader(native_path(path))


def check_size(path: Path, image_size_px: tuple[int, int], size_px: tuple[int, int] | None) -> None:
    """Refuse an image whose size differs from its camera's, (width, height).

    Raises:
        InputError: the sizes differ.
    """
    if size_px is not None and image_size_px != tuple(size_px):
        remedy = "use the images that the camera was calibrated with, or scale focal_px, centre_px and size_px to these images"
        raise input_error(path, f"{image_size_px[0]} x {image_size_px[1]} pixels", f"{size_px[0]} x {size_px[1]} as its camera has", remedy)


def not_seen(path: Path, problem: str, expected: str, remedy: str) -> NotSeenError:
    """The error for a frame without a picture; arguments as for `bayes_body.base.errors.input_error`."""
    return NotSeenError(str(input_error(path, problem, expected, remedy)))


def _read(path: Path, size_px: tuple[int, int] | None, flag: int) -> NDArray[np.uint8]:
    content = _content(path)
    missing = _missing_bytes(content)
    if missing:
        raise not_seen(path, f"cut short, {missing} of {len(content) + missing} bytes are missing", "a whole image", "copy the file again")
    image = _decoded(path, content, flag)
    if image is None:
        problem = f"not an image that OpenCV can read, or cut short ({len(content)} bytes)"
        raise not_seen(path, problem, "a whole bmp, png, jpg or tiff", "copy the file again")
    check_size(path, (image.shape[1], image.shape[0]), size_px)
    return np.asarray(image, np.uint8)


def _decoded(path: Path, content: bytes, flag: int) -> MatLike | None:
    try:
        with SILENT:
            return cv2.imdecode(np.frombuffer(content, np.uint8), flag)
    except cv2.error as error:
        # OpenCV reads the size in the header first, and refuses it before it allocates memory (`bayes_body` sets the limit).
        if "CV_IO_MAX_IMAGE" in str(error):
            problem = "more pixels than any camera has, according to its header"
            raise input_error(path, problem, f"at most {os.environ['OPENCV_IO_MAX_IMAGE_PIXELS']}", "copy the file again") from None
        return None


def _content(path: Path) -> bytes:
    try:
        content = read_bytes(path, "an image", LARGEST_BYTES)
    except NoSuchFileError:
        raise not_seen(path, "no such file", "an image", "restore it, or correct the session's image paths, first_frame and frames") from None
    if not content:
        # OpenCV raises an assertion error on an empty buffer.
        raise not_seen(path, "empty", "an image", "copy the file again")
    return content


def _missing_bytes(content: bytes) -> int:
    """How many bytes a BMP lacks according to its header; 0 for other formats. Some versions of OpenCV fill the missing rows silently."""
    if content[:2] != b"BM":
        return 0
    if len(content) < 34:
        return 34 - len(content)
    (full_size,) = struct.unpack_from("<I", content, 2)
    start, header, width, height, _, bits, compression = struct.unpack_from("<IIiiHHI", content, 10)
    # The file size in a header is often wrong, so it is used only where the rows cannot be counted. Rows are padded to 4 bytes.
    if header >= 40 and compression == 0:
        full_size = start + (abs(width) * bits + 31) // 32 * 4 * abs(height)
    return max(0, full_size - len(content))
