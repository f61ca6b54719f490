"""The subject's keypoints in all frames of one camera, and how the subject is followed among the people that the cameras see.

The keypoints are in an .npz beside a session, with

- `keypoints` (frame, keypoint, 3): column, row (pixels; NaN where not found) and confidence, between 0 and 1,
- `names` of the keypoints: those of the layouts (readers/keypoints.py), of the fifteen markers (evidence/markers.py), or others, which are ignored,
- `first`, the number of the first row's frame in the camera's numbering; 0 if missing,
- where a camera sees several people: which detections may be the subject's, and which are other people's (candidates.py).

`choose_person` finds the subject in the first frame. From then on, the subject in a camera is the person nearest to the projection of the previous
frame's body (with one camera: to the subject's place in the previous frame), if the distance is within a fifth of the person's size. Cameras that do
not agree with the body of this frame are dropped. If fewer than two cameras remain (with one camera: if no person is near), `choose_person` is called
again. If that fails too, the people who were near are used. Frames in which every camera sees at most one person, and all clearly the same, are
decided many at a time (`lone_person`).
"""

from collections import Counter
from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray

from bayes_body.base.errors import input_error
from bayes_body.base.files.arrays_file import read_arrays
from bayes_body.base.files.atomic import make_folder, replacing
from bayes_body.base.progress import Watch, unwatched
from bayes_body.recording.readers.keypoints.candidates import KEYS, Bystanders, Candidates, check_values, read_bystanders, read_candidates
from bayes_body.recording.readers.keypoints.lone_person import lone_bodies
from bayes_body.recording.readers.keypoints.openpose import MOST_KEYPOINTS
from bayes_body.recording.readers.keypoints.person import FEWEST, NEAR, SAME, People, choose_person
from bayes_body.recording.readers.keypoints.triangulate import reprojection_errors, triangulate
from bayes_body.recording.session.session import CameraSpec, Keypoints

KIND = "an .npz with `keypoints` (frame, keypoint, 3), pixels and confidence, and `names` of the keypoints"
REMEDY = "import the keypoints again, or write it with numpy.savez(path, keypoints=..., names=...)"
# Names that detectors use for joint centres of a body.
MARKERS = {"neck": "thorax", "mid_hip": "pelvis"}
KEPT = 64


class KeypointSeries(NamedTuple):
    """The content of such a file (see the module)."""

    keypoints: Float[np.ndarray, "frame keypoint 3"]
    names: tuple[str, ...]
    first: int
    candidates: Candidates | None = None
    bystanders: Bystanders | None = None

    def frame(self, number: int) -> dict[str, tuple[float, float, float]]:
        """The keypoints found in a frame (camera's numbering), under the marker's name where the keypoint is a marker."""
        row = self._row(number)
        return {} if row is None else self._named(self.keypoints[row])

    def candidates_in(self, number: int) -> list[tuple[Keypoints, float]]:
        """The keypoints of the subject's candidates in a frame (camera's numbering), with their shares; none without candidates."""
        row = self._row(number)
        if self.candidates is None or row is None:
            return []
        pairs = zip(self.candidates.points[row], self.candidates.shares[row].tolist(), strict=True)
        return [(self._named(points), share) for points, share in pairs if share > 0]

    def bystanders_in(self, number: int) -> Float[np.ndarray, "person keypoint 3"]:
        """The keypoints of other people in a frame (camera's numbering)."""
        row = self._row(number)
        return np.zeros((0, len(self.names), 3), np.float32) if self.bystanders is None or row is None else self.bystanders.frame(row)

    def named_bystanders_in(self, number: int) -> list[Keypoints]:
        """The keypoints of other people in a frame (camera's numbering), by name, as `frame` has the subject's."""
        return [self._named(points) for points in self.bystanders_in(number)]

    def _row(self, number: int) -> int | None:
        row = number - self.first
        return row if 0 <= row < len(self.keypoints) else None

    def _named(self, keypoints: Float[np.ndarray, "keypoint 3"]) -> dict[str, tuple[float, float, float]]:
        valid = np.isfinite(keypoints).all(axis=1) & (keypoints[:, 2] > 0)
        points = zip(self.names, keypoints.tolist(), valid.tolist(), strict=True)
        return {MARKERS.get(name, name): (column, line, confidence) for name, (column, line, confidence), is_valid in points if is_valid}


def write_series(path: Path, series: KeypointSeries) -> None:
    """Write the file; its folder is created if needed.

    Raises:
        InputError: it cannot be written.
    """
    make_folder(path.parent)
    arrays = {"keypoints": series.keypoints.astype(np.float32), "names": np.array(series.names), "first": np.array(series.first)}
    if series.candidates is not None:
        arrays |= {"candidates": series.candidates.points.astype(np.float32), "shares": series.candidates.shares.astype(np.float32)}
    if series.bystanders is not None:
        arrays |= {"bystanders": series.bystanders.points.astype(np.float32), "bystander_counts": series.bystanders.counts}
    with replacing(path) as partial:
        np.savez_compressed(partial, **arrays)


def read_series(path: Path) -> KeypointSeries:
    """The keypoints of a file. The most recently read files are cached in memory.

    Raises:
        InputError: no such file, or malformed.
    """
    try:
        state = path.stat().st_mtime_ns, path.stat().st_size
    except OSError:
        state = 0, 0
    return _read(path, state)


@lru_cache(maxsize=KEPT)
def _read(path: Path, state: tuple[int, int]) -> KeypointSeries:
    del state
    arrays = read_arrays(path, ("keypoints", "names", "first", *KEYS), KIND, REMEDY)
    for key in ("keypoints", "names"):
        if key not in arrays:
            raise input_error(path, f"no `{key}`", KIND, REMEDY)
    names = _names(path, arrays["names"])
    points, first = _points(path, arrays["keypoints"], len(names)), _first(path, arrays.get("first", np.array(0)))
    candidates = read_candidates(path, arrays, len(points), len(names), REMEDY)
    return KeypointSeries(points, names, first, candidates, read_bystanders(path, arrays, len(points), len(names), REMEDY))


def _names(path: Path, names: NDArray[np.generic]) -> tuple[str, ...]:
    keypoint_names = tuple(str(name) for name in names.ravel()) if names.dtype.kind == "U" and names.ndim == 1 else ()
    mapped = [MARKERS.get(name, name) for name in keypoint_names]
    if not 0 < len(keypoint_names) <= MOST_KEYPOINTS or len(set(mapped)) < len(mapped):
        twice = next((name for name, count in Counter(mapped).items() if count > 1), None)
        problem = f"'{twice[:40]}' twice" if twice is not None else f"{names.dtype} of shape {names.shape}"
        raise input_error(f"{path}: names", problem, "unique names of the keypoints", REMEDY)
    return keypoint_names


def _points(path: Path, points: NDArray[np.generic], count: int) -> Float[np.ndarray, "frame keypoint 3"]:
    subject = f"{path}: keypoints"
    if points.ndim != 3 or points.shape[1:] != (count, 3) or points.dtype.kind not in "fiu":
        raise input_error(subject, f"{points.dtype} of shape {points.shape}", f"numbers of shape (frame, {count}, 3)", REMEDY)
    # Files of this program have 32 bits, and a long recording's stay so in memory: numbers of single frames get more when they are read.
    points = np.asarray(points, np.float32 if points.dtype == np.float32 else np.float64)
    check_values(subject, points, REMEDY)
    return points


def _first(path: Path, first: NDArray[np.generic]) -> int:
    if first.dtype.kind not in "iu" or first.size != 1:
        raise input_error(f"{path}: first", f"{first.dtype} of shape {first.shape}", "a whole number, the number of the first frame", REMEDY)
    return int(first.ravel()[0])


FRAMES_AT_ONCE = 200

# With several cameras: the body's keypoints in the world, metres. With one camera: its keypoints in the image.
type Body = Float[np.ndarray, "keypoint _"]
type Places = tuple[int | None, ...]


class PersonFollower:
    """Follow the subject frame by frame, as frames come; it remembers the people and the body of the previous frame.

    Args:
        cameras: calibrated.
    """

    def __init__(self, cameras: Sequence[CameraSpec]):
        self._cameras = cameras
        self._previous_people: Sequence[Sequence[People]] = ()
        self._previous_body: Body | None = None

    def follow(self, frames: Sequence[Sequence[People]]) -> list[Places]:
        """For the next frames: the subject's index in each camera's list of people; None where the subject is not visible.

        Args:
            frames: for each frame and camera, column, row (pixels; NaN where not visible) and confidence.
        """
        bodies = lone_bodies(self._cameras, [*self._previous_people, *frames])[len(self._previous_people) :]
        self._previous_people = frames[-1:]
        return [self._choose(people) if body is None else self._take(people, body) for people, body in zip(frames, bodies, strict=True)]

    def _take(self, people: Sequence[People], body: Body) -> Places:
        """The only person of each camera."""
        self._previous_body = body
        return tuple(0 if len(among) else None for among in people)

    def _choose(self, people: Sequence[People]) -> Places:
        cameras, previous_body = self._cameras, self._previous_body
        nearest_people = tuple(_nearest(camera, among, previous_body) for camera, among in zip(cameras, people, strict=True))
        # Triangulation takes most of the time of a frame: if the nearest people are the subject, their body is not computed again.
        nearest_body = _body(cameras, people, nearest_people, previous_body)
        subject = _agreeing(cameras, people, nearest_people, nearest_body)
        if subject is None:
            chosen = choose_person(cameras, people)
            subject = nearest_people if chosen is None else chosen.places
        self._previous_body = nearest_body if subject == nearest_people else _body(cameras, people, subject, previous_body)
        return subject


def follow_person(cameras: Sequence[CameraSpec], frames: Sequence[Sequence[People]], watch: Watch = unwatched) -> list[Places]:
    """The subject's index in each camera's list of people, for each frame in order (`PersonFollower`).

    Args:
        cameras: calibrated.
        frames: for each frame and camera, column, row (pixels; NaN where not visible) and confidence.
        watch: shows how many batches of frames are done.
    """
    follower, places = PersonFollower(cameras), list[Places]()
    for start in watch(range(0, len(frames), FRAMES_AT_ONCE)):
        places += follower.follow(frames[start : start + FRAMES_AT_ONCE])
    return places


def _agreeing(cameras: Sequence[CameraSpec], people: Sequence[People], nearest_people: Places, body: Body | None) -> Places | None:
    """The people who are near and agree with the body that they show; None if too few cameras see it."""
    if len(cameras) > 1 and _count(nearest_people) > 1:
        rows = zip(cameras, people, nearest_people, strict=True)
        nearest_people = tuple(place if place is not None and _error(camera, body, among[place]) <= SAME else None for camera, among, place in rows)
    return nearest_people if _count(nearest_people) >= min(2, len(cameras)) else None


def _count(places: Places) -> int:
    return sum(place is not None for place in places)


def _nearest(camera: CameraSpec, people: People, body: Body | None) -> int | None:
    errors = [_error(camera, body, person) for person in people]
    error = min(errors, default=np.inf)
    return errors.index(error) if error <= NEAR else None


def _body(cameras: Sequence[CameraSpec], people: Sequence[People], places: Places, previous_body: Body | None) -> Body | None:
    """The body of this frame. If too little of it is known, the body of the previous frame."""
    visible = [(camera, among[place]) for camera, among, place in zip(cameras, people, places, strict=True) if place is not None]
    if len(visible) < min(2, len(cameras)):
        return previous_body
    body = (
        visible[0][1][:, :2]
        if len(cameras) == 1
        else triangulate([camera for camera, _ in visible], np.stack([person for _, person in visible])).points_m
    )
    return body if np.isfinite(body).all(axis=1).sum() >= FEWEST else previous_body


def _error(camera: CameraSpec, body: Body | None, person: Float[np.ndarray, "keypoint 3"]) -> float:
    """Median distance between a body and a person in the image, as a fraction of the person's size; infinite if they share too few keypoints."""
    visible = person[np.isfinite(person[:, :2]).all(axis=1), :2]
    if body is None or len(visible) < FEWEST:
        return np.inf
    distances = np.linalg.norm(body - person[:, :2], axis=1) if body.shape[1] == 2 else reprojection_errors([camera], body, person[None])[0]
    finite_distances = distances[~np.isnan(distances)]
    size = float(np.linalg.norm(np.ptp(visible, axis=0)))
    return float(np.median(finite_distances)) / size if len(finite_distances) >= FEWEST and size > 0 else np.inf
