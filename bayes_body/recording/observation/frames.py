"""A session's frames: what all cameras saw at one instant; and reading ahead of the consumer."""

from collections.abc import Callable, Generator, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import cached_property, lru_cache
from typing import NamedTuple, overload

import numpy as np
from numpy.typing import NDArray

from bayes_body.base.errors import input_error
from bayes_body.recording.observation.pictures import check_index, has_picture, read_colour, read_greys
from bayes_body.recording.observation.segmentation import EVEN
from bayes_body.recording.observation.silhouettes import has_silhouettes, silhouette_levels
from bayes_body.recording.readers.camera_path import cameras_at
from bayes_body.recording.readers.images import NotSeenError, read_mask
from bayes_body.recording.readers.keypoints.series import read_series
from bayes_body.recording.session.session import CameraSpec, Keypoints, Session, View


class Frame(NamedTuple):
    """One instant, with one entry per view; None for a camera that did not see it.

    `images` are grey values (height, width), read on first access if it was known before which cameras saw the frame. `masks` (height, width)
    come from the session's files, or are computed from the background. `foreground` is the probability of foreground, in [0, 1], float32; it is 0
    or 1 if masks are files. Both are computed on first access and may raise an InputError then. An image whose exposure cannot be matched to the
    background's has no silhouette. Both are None as a whole if the session can have no silhouettes: no masks, no empty scene, and too few frames
    to learn the background. `keypoints` are column, row (pixels) and confidence of the subject's keypoints, by the marker's name where they are
    markers, else by the detector's name. An entry is empty if nothing was found, and None if the camera has no keypoints or did not see the
    frame; all of it is None if no camera has any. `sizes_px` are (width, height) of every camera's images, including those that did not see the
    frame; () means the sizes of `images`. `cameras` have their extrinsics in this frame; () if they are not known. `before` is the frame before,
    if it was asked for and there is one; it knows no frame before itself. `have_image` says which cameras see the frame if that is known without
    reading the images.
    """

    index: int  # pyright: ignore[reportIncompatibleMethodOverride]
    images: Sequence[NDArray[np.uint8] | None]
    masks: Sequence[NDArray[np.bool_] | None] | None
    foreground: Sequence[NDArray[np.float32] | None] | None = None
    sizes_px: tuple[tuple[int, int], ...] = ()
    keypoints: tuple[Keypoints | None, ...] | None = None
    cameras: tuple[CameraSpec, ...] = ()
    before: "Frame | None" = None
    have_image: tuple[bool, ...] | None = None

    @property
    def seen(self) -> tuple[bool, ...]:
        """Which cameras have an image of this frame."""
        return self.have_image if self.have_image is not None else tuple(image is not None for image in self.images)

    @property
    def largest(self) -> tuple[int, int]:
        """(rows, columns) that hold an image of any camera: the same in every frame, whichever cameras see it."""
        sizes = self.sizes_px or [image.shape[::-1] for image in self.images if image is not None]
        return max(rows for _, rows in sizes), max(columns for columns, _ in sizes)


def masks_of(frame: Frame) -> Sequence[NDArray[np.bool_] | None]:
    """Return the masks of a frame.

    Raises:
        InputError: its session can have none.
    """
    if frame.masks is None:
        remedy = "give each [[camera]] its `masks`, or an image of the empty scene as `background`"
        problem = "its cameras have no masks, and there are too few frames to learn the background"
        raise input_error("session.toml", problem, "a silhouette for every image", remedy)
    return frame.masks


def read_frame(session: Session, index: int, with_before: bool = False, seen: Sequence[bool] | None = None) -> Frame:
    """Read frame `index` of a session, counted from 0.

    Args:
        session: the recording.
        index: the frame.
        with_before: whether to read the frame before too. The first frame has none.
        seen: which cameras have an image of it, if that is known. Images that nothing asks for are not read then.

    Raises:
        InputError: no such frame, not a video, an image of a wrong size, unreadable keypoints, or an unreadable path of a camera.
    """
    check_index(session, index)
    # First, because a video is read onwards.
    previous_frame = read_frame(session, index - 1) if with_before and index else None
    if seen is None:
        images = tuple(read_greys(session, index, view) for view in session.views)
        have_image = tuple(image is not None for image in images)
    else:
        have_image = tuple(seen)
        images = _images(session, index, have_image)
    sizes = tuple(view.camera.size_px for view in session.views)
    keypoints = _keypoints(session, index, have_image)
    if not has_silhouettes(session):
        return Frame(index, images, None, None, sizes, keypoints, cameras_at(session, index), previous_frame, have_image)
    silhouettes = [_Silhouette(session, index, view, has_image) for view, has_image in zip(session.views, have_image, strict=True)]
    masks = _OnDemand([lambda s=s: s.mask for s in silhouettes])
    foreground = _OnDemand([lambda s=s: s.foreground for s in silhouettes])
    return Frame(index, images, masks, foreground, sizes, keypoints, cameras_at(session, index), previous_frame, have_image)


def frame_of_keypoints(session: Session, index: int, keypoints: tuple[Keypoints | None, ...]) -> Frame:
    """Return frame `index` of a session, counted from 0, of which only keypoints are known: None for a camera that did not see it."""
    have_image = tuple(points is not None for points in keypoints)
    sizes = tuple(view.camera.size_px for view in session.views)
    cameras = tuple(view.camera for view in session.views)
    return Frame(index, (None,) * len(have_image), None, None, sizes, keypoints, cameras, None, have_image)


def cameras_with_picture(session: Session, index: int) -> tuple[bool, ...]:
    """Which cameras have a picture of a frame, without decoding any (`pictures.has_picture`). For a model that reads none, these see the frame.

    Raises:
        InputError: no such frame, or not a video.
    """
    return tuple(has_picture(session, index, view) for view in session.views)


def _images(session: Session, index: int, have_image: Sequence[bool]) -> Sequence[NDArray[np.uint8] | None]:
    """Return the images of the cameras that see the frame, each read on first access."""

    def image_of(view: View) -> Callable[[], NDArray[np.uint8] | None]:
        return lru_cache(1)(lambda: read_greys(session, index, view))

    return _OnDemand([image_of(view) if has_image else lambda: None for view, has_image in zip(session.views, have_image, strict=True)])


def _keypoints(session: Session, index: int, have_image: Sequence[bool]) -> tuple[Keypoints | None, ...] | None:
    paths = [session.keypoints_path(view) for view in session.views]
    if not any(paths):
        return None
    numbers = [session.number(view, index) for view in session.views]
    return tuple(read_series(path).frame(k) if path and has_image else None for path, k, has_image in zip(paths, numbers, have_image, strict=True))


class _Silhouette:
    """The silhouette in a camera's image, computed on first access."""

    def __init__(self, session: Session, index: int, view: View, has_image: bool):
        self._session, self._index, self._view, self._has_image = session, index, view, has_image

    @cached_property
    def mask(self) -> NDArray[np.bool_] | None:
        if not self._has_image:
            return None
        path = self._session.mask_path(self._view, self._index)
        if path is None:
            return None if self._levels is None else self._levels > EVEN
        try:
            return read_mask(path, self._view.camera.size_px)
        except NotSeenError:
            return None

    @cached_property
    def foreground(self) -> NDArray[np.float32] | None:
        if self._view.masks is not None:
            return None if self.mask is None else self.mask.astype(np.float32)
        return None if self._levels is None else self._levels * np.float32(1 / 255)

    @cached_property
    def _levels(self) -> NDArray[np.uint8] | None:
        image = read_colour(self._session, self._index, self._view) if self._has_image else None
        return None if image is None else silhouette_levels(self._session, self._view, image)


class _OnDemand[Item](Sequence[Item]):
    """A sequence whose items are computed on access."""

    def __init__(self, make: Sequence[Callable[[], Item]]):
        self._make = tuple(make)

    def __len__(self) -> int:
        return len(self._make)

    @overload
    def __getitem__(self, index: int) -> Item: ...
    @overload
    def __getitem__(self, index: slice) -> Sequence[Item]: ...
    def __getitem__(self, index: int | slice) -> Item | Sequence[Item]:
        return _OnDemand(self._make[index]) if isinstance(index, slice) else self._make[index]()


def prefetch[Item, Result](items: Iterable[Item], function: Callable[[Item], Result]) -> Generator[Result, None, None]:
    """Yield `function(item)` for each item, in order. A background thread computes the next one while the consumer works on this one.

    An exception in the function or in `items` is raised when its item's turn comes. If the consumer stops early, it waits for the item in progress.
    """
    remaining = iter(items)
    end = object()

    def following() -> Result | object:
        # A StopIteration cannot pass through a future into a generator.
        item = next(remaining, end)
        return end if item is end else function(item)  # pyright: ignore[reportArgumentType]

    with ThreadPoolExecutor(max_workers=1, thread_name_prefix="prefetch") as pool:
        pending = pool.submit(following)
        while (result := pending.result()) is not end:
            pending = pool.submit(following)
            yield result  # pyright: ignore[reportReturnType]
