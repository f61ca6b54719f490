"""What one camera saw at one instant: an image from a file or a video, or nothing.

Pictures that are expensive to compute are cached in compressed form.
"""

import threading
import zlib
from collections.abc import Callable, Hashable
from pathlib import Path

import cv2
import numpy as np
from cv2.typing import MatLike
from jaxtyping import UInt8

from bayes_body.base.errors import input_error
from bayes_body.recording.readers.images import NotSeenError, not_seen, read_grey
from bayes_body.recording.readers.images import read_colour as read_colour_image
from bayes_body.recording.readers.videos.video import has_video_frame, read_video_frame
from bayes_body.recording.session.session import Session, View

# An image with a smaller standard deviation of grey values shows nothing: the camera was off, covered or blinded.
LEAST_CONTRAST = 2.5

type Greys = UInt8[np.ndarray, "row column"]
type Colours = UInt8[np.ndarray, "row column 3"]


def read_colour(session: Session, index: int, view: View) -> Colours | None:
    """A frame's image in blue, green and red; None if the camera did not see the frame.

    That is the case if its file is missing, truncated or not an image, if its video has ended, or if the image is almost constant.

    Raises:
        InputError: no such frame, not a video, or an image whose size differs from its camera's.
    """
    check_index(session, index)
    try:
        image = _read_video(session, index, view)
        if image is None:
            image = read_colour_image(_image_path(session, index, view), view.camera.size_px)
    except NotSeenError:
        return None
    return image if _shows_something(cv2.cvtColor(image[::4, ::4], cv2.COLOR_BGR2GRAY)) else None


def read_greys(session: Session, index: int, view: View) -> Greys | None:
    """A frame's grey values; None if the camera did not see the frame. Errors as for `read_colour`."""
    check_index(session, index)
    try:
        image = _read_video(session, index, view)
        grey = read_grey(_image_path(session, index, view), view.camera.size_px) if image is None else cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
    except NotSeenError:
        return None
    return np.asarray(grey, np.uint8) if _shows_something(grey[::4, ::4]) else None


def has_picture(session: Session, index: int, view: View) -> bool:
    """Whether a camera has an image of a frame, without decoding it: its file exists, or its video is long enough.

    An image that is damaged, or almost constant, is not noticed. `read_greys` returns None for it.

    Raises:
        InputError: no such frame, or not a video.
    """
    check_index(session, index)
    path = session.video_path(view)
    if path is None:
        return _image_path(session, index, view).is_file()
    number = session.file_number(view, index)
    return number is not None and has_video_frame(path, number)


def check_index(session: Session, index: int) -> None:
    """Refuse a frame that the session does not have.

    Raises:
        InputError: it does not have it.
    """
    if not 0 <= index < session.frames:
        raise input_error(session.title, f"frame {index}", f"0 to {session.frames - 1}", "choose a frame of the session")


def _read_video(session: Session, index: int, view: View) -> Colours | None:
    path, number = session.video_path(view), session.file_number(view, index)
    if path is None:
        return None
    if number is None:
        problem, remedy = f"no frame at instant {session.number(view, index)}", "correct the camera's spans in session.toml, or import it again"
        raise not_seen(path, problem, "a frame at this time", remedy)
    return read_video_frame(path, number, view.camera.size_px)


def _image_path(session: Session, index: int, view: View) -> Path:
    path = session.image_path(view, index)
    if path is None:
        problem = "neither images nor video"
        raise input_error(f"{session.title}: camera '{view.camera.name}'", problem, "one of the two", "give it `images` or `video`")
    return path


def _shows_something(grey: MatLike) -> bool:
    return float(grey.std()) >= LEAST_CONTRAST


type Picture = UInt8[np.ndarray, "row column"]
# A compressed picture: its shape and its bytes.
type Packed = tuple[tuple[int, ...], bytes]


class PictureCache:
    """At most so many bytes of the pictures of one owner; a new owner's pictures replace them. A full cache keeps no further pictures.

    A recording is read from its first frame to its last, several times. A cache that replaced its oldest picture by its newest would never have a
    hit.
    """

    def __init__(self, most_bytes: int):
        self._most, self._lock = most_bytes, threading.Lock()
        self._owner: Hashable = None
        self._bytes, self._packed = 0, dict[Hashable, Packed | None]()

    def get(self, owner: Hashable, key: Hashable, make: Callable[[], Picture | None]) -> Picture | None:
        """The picture of a key, computed if it is not cached; cached pictures are read-only."""
        with self._lock:
            if owner != self._owner:
                self._owner, self._bytes, self._packed = owner, 0, {}
            cached, packed = key in self._packed, self._packed.get(key)
        if cached:
            return None if packed is None else np.frombuffer(zlib.decompress(packed[1]), np.uint8).reshape(packed[0])
        picture = make()
        self._keep(owner, key, None if picture is None else (picture.shape, zlib.compress(picture, 1)))
        return picture

    def _keep(self, owner: Hashable, key: Hashable, packed: Packed | None) -> None:
        size = 0 if packed is None else len(packed[1])
        with self._lock:
            if owner == self._owner and key not in self._packed and self._bytes + size <= self._most:
                self._bytes += size
                self._packed[key] = packed
