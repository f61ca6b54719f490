"""The silhouettes of a session without masks. Each camera's background is learned on first use and cached in memory.

Silhouettes are cached too, up to a limit: a run needs each one when it tracks, measures and draws the frame.
"""

import hashlib
import threading
from collections import OrderedDict
from collections.abc import Hashable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import UInt8

from bayes_body.base.errors import input_error
from bayes_body.recording.observation.background import Background, learn_background, shrink, still_background
from bayes_body.recording.observation.pictures import Colours, PictureCache, read_colour
from bayes_body.recording.observation.prefetch import threads_for_work
from bayes_body.recording.observation.segmentation import foreground_levels
from bayes_body.recording.readers.images import is_image
from bayes_body.recording.readers.images import read_colour as read_colour_image
from bayes_body.recording.readers.videos.video import probe, read_video_frame, readable_frames
from bayes_body.recording.session.session import Session, View

# With fewer frames no background is learned: a person would be in most of them.
LEAST_FRAMES = 10
# Number of cached backgrounds, and bytes of cached silhouettes: those of some thousand pictures.
KEPT, KEPT_BYTES = 32, 64 << 20

_backgrounds: OrderedDict[Hashable, Background] = OrderedDict()
_lock = threading.Lock()
_made = PictureCache(KEPT_BYTES)


def has_silhouettes(session: Session) -> bool:
    """Whether every camera has masks, an empty scene, or enough frames to learn the background."""
    return all(view.masks is not None or view.background is not None or session.recorded_session.frames >= LEAST_FRAMES for view in session.views)


def silhouette_levels(session: Session, view: View, image: Colours) -> UInt8[np.ndarray, "row column"] | None:
    """The foreground's probability times 255 for a camera's image; None if the image's exposure cannot be matched to the background's.

    Raises:
        InputError: the background cannot be learned, or its file cannot be used.
    """
    background = background_of(session, view)
    small = shrink(image)
    # The key is the content: the same picture has the same silhouette, whatever its number and file date.
    key = _key(session, view), hashlib.sha1(np.ascontiguousarray(small), usedforsecurity=False).digest()
    levels = _made.get(str(session.folder), key, lambda: foreground_levels(background, small, session.segmentation))
    return None if levels is None else np.asarray(cv2.resize(levels, image.shape[1::-1], interpolation=cv2.INTER_LINEAR), np.uint8)


def background_of(session: Session, view: View) -> Background:
    """A camera's background, from the empty scene or from the recording.

    Raises:
        InputError: there are too few frames, or the empty scene's file cannot be used.
    """
    key = _key(session, view)
    with _lock:
        if key not in _backgrounds:
            _learn_all(session, view, key)
        background = _backgrounds[key]
        _backgrounds.move_to_end(key)
    return background


def _key(session: Session, view: View) -> Hashable:
    """Everything that a background depends on."""
    source, recorded_session = (view.images, view.video, view.background, view.offset, view.spans, view.camera.size_px), session.recorded_session
    return (
        str(session.folder),
        recorded_session.first_frame,
        recorded_session.frames,
        session.segmentation,
        source,
        _state(session.background_path(view)),
    )


def _state(path: Path | None) -> tuple[int, int] | None:
    if path is None or not path.exists():
        return None
    return path.stat().st_mtime_ns, path.stat().st_size


def _learn_all(session: Session, view: View, key: Hashable) -> None:
    """Learn the background of a camera, and at the same time those of the other cameras, which are wanted next.

    Raises:
        InputError: that of this camera cannot be learned. An error of another camera is raised when that one is wanted.
    """
    views = {_key(session, camera): camera for camera in session.views if camera.masks is None}
    unlearned = {camera_key: camera for camera_key, camera in list(views.items())[:KEPT] if camera_key not in _backgrounds}
    with ThreadPoolExecutor(threads_for_work(), thread_name_prefix="background") as pool:
        learning = {camera_key: pool.submit(_learn, session, camera) for camera_key, camera in {key: view, **unlearned}.items()}
    for camera_key, background in reversed(learning.items()):
        if camera_key == key or background.exception() is None:
            _backgrounds[camera_key] = background.result()
    while len(_backgrounds) > KEPT:
        _backgrounds.popitem(last=False)


def _learn(session: Session, view: View) -> Background:
    path, size = session.background_path(view), view.camera.size_px
    if path is not None and (not path.is_file() or is_image(path)):
        return still_background(read_colour_image(path, size))
    options = session.segmentation
    source = _recording(session, view) if path is None else _video(path, size, options.learning_frames)
    images = [shrink(image) for image in source]
    if len(images) < (LEAST_FRAMES if path is None else 1):
        problem = f"{len(images)} of its frames can be read, and it has neither masks nor an empty scene"
        remedy = "give it `background`, an image or a video of the empty scene, or `masks`"
        raise input_error(f"{session.title}: camera '{view.camera.name}'", problem, f"{LEAST_FRAMES} or more to learn the background", remedy)
    return learn_background(images, options.follow_exposure)


def _recording(session: Session, view: View) -> Iterator[Colours]:
    # Frames outside of the session's range show the scene too.
    recorded_session = session.recorded_session
    for index in _evenly(recorded_session.frames, session.segmentation.learning_frames):
        image = read_colour(recorded_session, index, view)
        if image is not None:
            yield image


def _video(path: Path, size: tuple[int, int], count: int) -> Iterator[Colours]:
    for number in _evenly(readable_frames(path, probe(path).frames), count):
        yield read_video_frame(path, number, size)


def _evenly(frames: int, count: int) -> list[int]:
    return np.unique(np.linspace(0, frames - 1, min(count, frames)).round().astype(int)).tolist()
