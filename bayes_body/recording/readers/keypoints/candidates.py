"""Which detections may be the subject's, and which are other people's, where a camera sees several people. They are in the file of `series.py`.

- `candidates` (frame, candidate, keypoint, 3): column, row (pixels; NaN where not seen) and confidence of the detections that may be the
  subject's, by descending share; NaN for frames with fewer of them.
- `shares` (frame, candidate): the probability that a candidate is the subject's, given where the people of the recording are. What is missing to 1
  is the probability that no detection is the subject's.
- `bystanders` (detection, keypoint, 3): the detections that are other people's, frame by frame; `bystander_counts` (frame,): how many a frame has.

`readers/people` makes them.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from numpy.typing import NDArray

from bayes_body.base.errors import input_error
from bayes_body.recording.readers.keypoints.openpose import FARTHEST_PX

KEYS = ("candidates", "shares", "bystanders", "bystander_counts")
# A rounding error of 16 bits.
TOLERANCE = 1e-3


class Candidates(NamedTuple):
    """The subject's candidates in all frames of one camera (see the module)."""

    points: Float[np.ndarray, "frame candidate keypoint 3"]
    shares: Float[np.ndarray, "frame candidate"]


class Bystanders(NamedTuple):
    """The detections of other people in all frames of one camera (see the module)."""

    points: Float[np.ndarray, "detection keypoint 3"]
    counts: Int[np.ndarray, " frame"]

    def frame(self, row: int) -> Float[np.ndarray, "person keypoint 3"]:
        """The detections in a frame, counted from 0."""
        end = int(self.counts[: row + 1].sum())
        return self.points[end - int(self.counts[row]) : end]


def read_candidates(path: Path, arrays: Mapping[str, NDArray[np.generic]], frames: int, keypoints: int, remedy: str) -> Candidates | None:
    """Return the candidates among the arrays of a file; None if it has none.

    Args:
        path: the file.
        arrays: its arrays.
        frames: how many it has.
        keypoints: how many it has.
        remedy: what the user can do, as the end of a sentence.

    Raises:
        InputError: only one of the two arrays, of another shape, or shares that are no probabilities.
    """
    if "candidates" not in arrays and "shares" not in arrays:
        return None
    _check_pair(path, arrays, "candidates", "shares", remedy)
    points, shares = np.asarray(arrays["candidates"]), np.asarray(arrays["shares"])
    if points.ndim != 4 or points.shape[0] != frames or points.shape[2:] != (keypoints, 3) or points.dtype.kind != "f":
        problem = f"{points.dtype} of shape {points.shape}"
        raise input_error(f"{path}: candidates", problem, f"numbers of shape ({frames}, candidate, {keypoints}, 3)", remedy)
    if shares.shape != points.shape[:2] or shares.dtype.kind != "f":
        raise input_error(f"{path}: shares", f"{shares.dtype} of shape {shares.shape}", f"numbers of shape {points.shape[:2]}", remedy)
    check_values(f"{path}: candidates", points, remedy)
    shares = np.asarray(shares, np.float32)
    if not (shares >= 0).all() or (shares.sum(axis=1) > 1 + TOLERANCE).any():
        raise input_error(f"{path}: shares", "negative, or more than 1 in a frame", "probabilities that add up to at most 1 in a frame", remedy)
    return Candidates(np.asarray(points, np.float32), shares)


def read_bystanders(path: Path, arrays: Mapping[str, NDArray[np.generic]], frames: int, keypoints: int, remedy: str) -> Bystanders | None:
    """Return the detections of other people among the arrays of a file; None if it has none. Arguments are those of `read_candidates`.

    Raises:
        InputError: only one of the two arrays, of another shape, or counts that do not add up to the detections.
    """
    if "bystanders" not in arrays and "bystander_counts" not in arrays:
        return None
    _check_pair(path, arrays, "bystanders", "bystander_counts", remedy)
    points, counts = np.asarray(arrays["bystanders"]), np.asarray(arrays["bystander_counts"])
    if points.ndim != 3 or points.shape[1:] != (keypoints, 3) or points.dtype.kind != "f":
        raise input_error(f"{path}: bystanders", f"{points.dtype} of shape {points.shape}", f"numbers of shape (detection, {keypoints}, 3)", remedy)
    check_values(f"{path}: bystanders", points, remedy)
    if counts.shape != (frames,) or not are_counts(counts, len(points)):
        expected = f"{frames} whole numbers that add up to {len(points)}, the detections"
        raise input_error(f"{path}: bystander_counts", f"{counts.dtype} of shape {counts.shape}", expected, remedy)
    return Bystanders(np.asarray(points, np.float32), counts.astype(np.int64))


def check_values(subject: str, points: Float[np.ndarray, "*_ 3"], remedy: str) -> None:
    """Refuse what no network writes.

    Args:
        subject: what has the faults, as the beginning of a sentence.
        points: column, row (pixels; NaN where not seen) and confidence.
        remedy: what the user can do, as the end of a sentence.

    Raises:
        InputError: a confidence is not between 0 and 1, or a place is far outside any image.
    """
    confidence = points[..., 2][np.isfinite(points[..., 2])]
    if confidence.size and (confidence.min() < 0 or confidence.max() > 1):
        raise input_error(subject, f"a confidence of {max(confidence.max(), -confidence.min()):g}", "0 to 1", "divide by the largest possible")
    pixels = np.abs(points[..., :2])
    if (pixels[~np.isnan(pixels)] > FARTHEST_PX).any():
        raise input_error(subject, "a keypoint far outside any image", "pixels, or NaN where not found", remedy)


def are_counts(counts: NDArray[np.generic], total: int) -> bool:
    """Whether an array has whole numbers from 0 up that add up to a total."""
    if counts.ndim != 1 or counts.dtype.kind not in "iu":
        return False
    numbers = counts.astype(np.int64)
    # Each is within the total: sums of larger ones may wrap around.
    return bool(((numbers >= 0) & (numbers <= total)).all()) and int(numbers.sum()) == total


def _check_pair(path: Path, arrays: Mapping[str, NDArray[np.generic]], first: str, second: str, remedy: str) -> None:
    missing = [key for key in (first, second) if key not in arrays]
    if missing:
        raise input_error(path, f"no `{missing[0]}`", f"`{first}` and `{second}`, or neither", remedy)
