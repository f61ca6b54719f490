"""All detections of a recording's cameras, as files beside the session: an .npz for each camera, with

- `detections` (detection, keypoint, 3): column, row (pixels; NaN where not seen) and confidence, frame by frame,
- `counts` (frame,): how many detections a frame has,
- `names` of the keypoints, and `first`, the number of the first frame in the camera's numbering, as in keypoints/series.py.

An import writes them if a camera sees more than one person in a frame.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from bayes_body.base.errors import input_error
from bayes_body.base.files.arrays_file import read_arrays
from bayes_body.base.files.atomic import make_folder, replacing
from bayes_body.recording.readers.keypoints.candidates import are_counts, check_values
from bayes_body.recording.readers.keypoints.person import People
from bayes_body.recording.session.session import Session, View

FOLDER = "detections"
# Who is there, in short (presence.py).
PEOPLE_FILE = "people.json"
KIND = "an .npz with all detections of a camera, written by `bayes-body import`"
REMEDY = "import the recording again"
KEYS = ("detections", "counts", "names", "first")


def detections_path(session: Session, view: View) -> Path:
    """The file of a camera's detections."""
    return session.folder / FOLDER / f"{view.camera.name}.npz"


def has_detections(session: Session) -> bool:
    """Whether an import kept all people of the keypoint files."""
    return any(detections_path(session, view).exists() for view in session.views)


def remove_detections(session: Session) -> None:
    """Remove the files of an earlier import."""
    for path in (*(detections_path(session, view) for view in session.views), session.folder / FOLDER / PEOPLE_FILE):
        path.unlink(missing_ok=True)


def write_detections(session: Session, views: Sequence[View], people: Sequence[Sequence[People]], names: Sequence[str]) -> None:
    """Write the files.

    Args:
        session: whose frames they are.
        views: the cameras with keypoints.
        people: for each frame and camera.
        names: of the keypoints.

    Raises:
        InputError: the file system refuses it.
    """
    for c, view in enumerate(views):
        groups = [frame[c] if len(frame[c]) else np.zeros((0, len(names), 3)) for frame in people]
        path = detections_path(session, view)
        make_folder(path.parent)
        with replacing(path) as partial:
            np.savez_compressed(
                partial,
                detections=np.concatenate(groups).astype(np.float32),
                counts=np.array([len(group) for group in groups]),
                names=np.array(names),
                first=np.array(session.number(view, 0)),
            )


def read_detections(session: Session) -> tuple[list[View], list[list[People]], tuple[str, ...]]:
    """Return the cameras with keypoints, the people of each frame and camera, and the names of the keypoints.

    Raises:
        InputError: a file cannot be read, or does not belong to the session.
    """
    views = [view for view in session.views if detections_path(session, view).exists()]
    if not views:
        problem = "no detections of several people"
        raise input_error(session.folder, problem, f"a folder {FOLDER}, which an import of several people writes", REMEDY)
    cameras, listed = [], set[tuple[str, ...]]()
    for view in views:
        path = detections_path(session, view)
        arrays = read_arrays(path, KEYS, KIND, REMEDY)
        names = _names(path, arrays)
        listed.add(names)
        cameras.append(_groups(path, arrays, session, view, len(names)))
    if len(listed) > 1:
        raise input_error(session.folder / FOLDER, "cameras with different keypoints", "the same keypoints for all cameras", REMEDY)
    return views, [list(frame) for frame in zip(*cameras, strict=True)], listed.pop()


def _names(path: Path, arrays: Mapping[str, NDArray[np.generic]]) -> tuple[str, ...]:
    missing = [key for key in KEYS if key not in arrays]
    if missing:
        raise input_error(path, f"no `{missing[0]}`", KIND, REMEDY)
    return tuple(str(name) for name in arrays["names"].ravel())


def _groups(path: Path, arrays: Mapping[str, NDArray[np.generic]], session: Session, view: View, keypoints: int) -> list[People]:
    """The people of each frame of the session in one camera; nobody in frames that the file does not have."""
    points, counts, first = (np.asarray(arrays[key]) for key in ("detections", "counts", "first"))
    if points.ndim != 3 or points.shape[1:] != (keypoints, 3) or points.dtype.kind != "f":
        problem = f"{points.dtype} of shape {points.shape}"
        raise input_error(f"{path}: detections", problem, f"numbers of shape (detection, {keypoints}, 3)", REMEDY)
    check_values(f"{path}: detections", points, REMEDY)
    if first.dtype.kind not in "iu" or first.size != 1:
        raise input_error(f"{path}: first", f"{first.dtype} of shape {first.shape}", "a whole number, the number of the first frame", REMEDY)
    if not are_counts(counts, len(points)):
        problem = f"{counts.dtype} of shape {counts.shape}"
        raise input_error(f"{path}: counts", problem, f"whole numbers that add up to {len(points)}, the detections", REMEDY)
    counts = counts.astype(np.int64)
    ends = np.cumsum(counts)
    rows = [session.number(view, frame) - int(first.ravel()[0]) for frame in range(session.frames)]
    nobody = np.zeros((0, keypoints, 3))
    return [points[ends[row] - counts[row] : ends[row]].astype(float) if 0 <= row < len(counts) else nobody for row in rows]
