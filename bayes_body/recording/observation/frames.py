"""A session's frames: what all cameras saw at one instant."""

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import cache, cached_property
from typing import NamedTuple, overload

import cv2
import numpy as np
from numpy.typing import NDArray

from bayes_body.base.errors import input_error
from bayes_body.recording.observation.covered import ambiguous, beside_body, covered_by, uncovered
from bayes_body.recording.observation.pictures import Colours, Greys, check_index, has_picture, read_colour, read_greys
from bayes_body.recording.observation.segmentation import EVEN
from bayes_body.recording.observation.silhouettes import has_silhouettes, silhouette_levels
from bayes_body.recording.readers.camera_path import cameras_at
from bayes_body.recording.readers.images import NotSeenError, read_mask
from bayes_body.recording.readers.keypoints.series import KeypointSeries, read_series
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
    reading the images. `candidates` are the detections that may be the subject's, where the session knows several people: for each camera, keypoints
    and share, as many as the camera with the most has in any frame, so that all frames have one form; a missing one has no keypoints and the share 0.
    `covered` (row, column) is where other people cover each camera's image: not seen, for all that reads silhouettes. It is computed on first access,
    and None for a camera that sees no other person in this frame. Both are None as a whole where no camera sees several people in any frame, but
    `covered` is not where the session says that a silhouette may be of several people. `colours` are the images in blue, green and red, read on first
    access; None as a whole if only keypoints are known.
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
    candidates: tuple[tuple[tuple[Keypoints, float], ...], ...] | None = None
    covered: Sequence[NDArray[np.bool_] | None] | None = None
    colours: Sequence[Colours | None] | None = None

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


def covered_of(frame: Frame) -> Sequence[NDArray[np.bool_] | None]:
    """Return where other people cover each camera's image; None for a camera that sees no other person."""
    return (None,) * len(frame.images) if frame.covered is None else frame.covered


def read_frame(
    session: Session, index: int, with_before: bool = False, seen: Sequence[bool] | None = None, at_once: ThreadPoolExecutor | None = None
) -> Frame:
    """Read frame `index` of a session, counted from 0.

    Args:
        session: the recording.
        index: the frame.
        with_before: whether to read the frame before too. The first frame has none.
        seen: which cameras have an image of it, if that is known. Images that nothing asks for are not read then.
        at_once: threads that read the cameras' pictures at once, and now: those of videos too that may not be asked for. Frames that are not used
            in their order must be read like this, because a video is read onwards.

    Raises:
        InputError: no such frame, not a video, an image of a wrong size, unreadable keypoints, or an unreadable path of a camera.
    """
    check_index(session, index)
    # First, because a video is read onwards.
    previous_frame = read_frame(session, index - 1, at_once=at_once) if with_before and index else None
    pictures = [_Picture(session, index, view) for view in session.views]
    wanted = [seen is None or (at_once is not None and seen[number] and view.video is not None) for number, view in enumerate(session.views)]
    greys = list((map if at_once is None else at_once.map)(lambda picture, is_wanted: picture.grey if is_wanted else None, pictures, wanted))
    have_image = tuple(grey is not None for grey in greys) if seen is None else tuple(seen)
    seen_pictures = [picture if has_image else None for picture, has_image in zip(pictures, have_image, strict=True)]
    images = _OnDemand([lambda p=picture: None if p is None else p.grey for picture in seen_pictures])
    colours = _OnDemand([lambda p=picture: None if p is None else p.colour for picture in seen_pictures])
    sizes = tuple(view.camera.size_px for view in session.views)
    series = _series(session, index, have_image)
    keypoints, cameras = _keypoints(series), cameras_at(session, index)
    candidates, covered = _candidates(series), _covered(session, series)
    if not has_silhouettes(session):
        return Frame(index, images, None, None, sizes, keypoints, cameras, previous_frame, have_image, candidates, covered, colours)
    silhouettes = [_Silhouette(session, index, view, picture) for view, picture in zip(session.views, seen_pictures, strict=True)]
    masks = _OnDemand([lambda s=s: s.mask for s in silhouettes])
    foreground = _OnDemand([lambda s=s: s.foreground for s in silhouettes])
    if covered is not None:
        covered = _OnDemand([_whole_region(covered, masks, camera) for camera in range(len(masks))])
    elif session.segmentation.figures == "near_body":
        covered = (None,) * len(masks)
    return Frame(index, images, masks, foreground, sizes, keypoints, cameras, previous_frame, have_image, candidates, covered, colours)


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


# The file of each camera's keypoints, and the frame's number in it; None for a camera that did not see the frame.
type Series = Sequence[tuple[KeypointSeries | None, int | None]]


def _keypoints(series: Series) -> tuple[Keypoints | None, ...] | None:
    if all(file is None for file, _ in series):
        return None
    return tuple(None if file is None or number is None else file.frame(number) for file, number in series)


def _series(session: Session, index: int, have_image: Sequence[bool]) -> Series:
    paths = [session.keypoints_path(view) for view in session.views]
    numbers = [session.number(view, index) if has_image else None for view, has_image in zip(session.views, have_image, strict=True)]
    return [(None if path is None else read_series(path), number) for path, number in zip(paths, numbers, strict=True)]


def _candidates(series: Series) -> tuple[tuple[tuple[Keypoints, float], ...], ...] | None:
    most = max((file.candidates.shares.shape[1] for file, _ in series if file is not None and file.candidates is not None), default=0)
    if not most:
        return None
    listed = [[] if file is None or number is None else _of_camera(file, number) for file, number in series]
    return tuple(tuple(candidates + [({}, 0.0)] * (most - len(candidates))) for candidates in listed)


def _of_camera(file: KeypointSeries, number: int) -> list[tuple[Keypoints, float]]:
    """The candidates of a camera. A camera without several people has its only detection, which is the subject's."""
    if file.candidates is None:
        points = file.frame(number)
        return [(points, 1.0)] if points else []
    return file.candidates_in(number)


def bystanders_at(session: Session, index: int) -> tuple[list[Keypoints], ...]:
    """The keypoints of other people in each camera in frame `index`, counted from 0.

    Raises:
        InputError: unreadable keypoints.
    """
    series = _series(session, index, (True,) * len(session.views))
    return tuple([] if file is None or number is None else file.named_bystanders_in(number) for file, number in series)


def _covered(session: Session, series: Series) -> "_OnDemand[NDArray[np.bool_] | None] | None":
    if all(file is None or file.bystanders is None for file, _ in series):
        return None
    rows = zip(session.views, series, strict=True)
    return _OnDemand([_region(file, number, view.camera.size_px) for view, (file, number) in rows])


def _region(file: KeypointSeries | None, number: int | None, size_px: tuple[int, int]) -> Callable[[], NDArray[np.bool_] | None]:
    # Several likelihoods and measures ask for it.
    return cache(lambda: None if file is None or number is None else covered_by(file.named_bystanders_in(number), size_px))


def _whole_region(
    covered: Sequence[NDArray[np.bool_] | None], masks: Sequence[NDArray[np.bool_] | None], camera: int
) -> Callable[[], NDArray[np.bool_] | None]:
    """The region that is not seen, as the silhouette shows it."""

    def region() -> NDArray[np.bool_] | None:
        by_keypoints, mask = covered[camera], masks[camera]
        return by_keypoints if mask is None or by_keypoints is None else ambiguous(mask, by_keypoints)

    return cache(region)


def near_bodies(frame: Frame, bodies: Sequence[NDArray[np.bool_]]) -> Frame:
    """Return a frame in which figures of the silhouettes that a body does not explain count as not seen (`covered.beside_body`).

    Args:
        frame: the frame.
        bodies: the projection of the body into each camera's image, (row, column).

    Raises:
        InputError: its session can have no silhouettes, or one cannot be computed.
    """
    regions = list[NDArray[np.bool_] | None]()
    for mask, body, hidden in zip(masks_of(frame), bodies, covered_of(frame), strict=True):
        figures = None if mask is None else beside_body(uncovered(mask, hidden), body)
        regions.append(hidden if figures is None else figures if hidden is None else hidden | figures)
    return frame._replace(covered=regions)


class _Picture:
    """A camera's picture, read on first access. A video's frame is decoded once, for its grey values and for its silhouette."""

    def __init__(self, session: Session, index: int, view: View):
        self._session, self._index, self._view = session, index, view

    @cached_property
    def colour(self) -> Colours | None:
        return read_colour(self._session, self._index, self._view)

    @cached_property
    def grey(self) -> Greys | None:
        if self._session.video_path(self._view) is None:
            return read_greys(self._session, self._index, self._view)
        return None if self.colour is None else np.asarray(cv2.cvtColor(self.colour, cv2.COLOR_BGR2GRAY), np.uint8)


class _Silhouette:
    """The silhouette in a camera's image, computed on first access."""

    def __init__(self, session: Session, index: int, view: View, picture: _Picture | None):
        self._session, self._index, self._view, self._picture = session, index, view, picture

    @cached_property
    def mask(self) -> NDArray[np.bool_] | None:
        if self._picture is None:
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
        image = None if self._picture is None else self._picture.colour
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
