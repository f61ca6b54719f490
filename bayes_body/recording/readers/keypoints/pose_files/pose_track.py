"""The people of one camera, as a file of a whole video has them."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

# Far outside any image; a larger coordinate is damage.
FARTHEST_PX = 1e6
MOST_FRAMES = 1_000_000

type People = Float[np.ndarray, "person keypoint 3"]


class PoseTrack(NamedTuple):
    """The people of one camera.

    Attributes:
        program: the program that wrote the file.
        people: for each frame that the file has, column, row (pixels; NaN where not seen) and confidence, from 0 to 1.
        names: names of the keypoints as this project writes them; None if only their number is known.
        unclipped: the largest confidence in the file, if it is above 1, else None.
    """

    program: str
    people: Mapping[int, People]
    names: tuple[str, ...] | None
    unclipped: float | None = None


def people_of(rows: Sequence[Float[np.ndarray, "keypoint 3"]]) -> People:
    """Return the people of a frame. Where a coordinate is not finite or far outside any image, a keypoint is not seen, whatever its confidence."""
    if not rows:
        return np.zeros((0, 0, 3))
    people = np.stack(rows).astype(float)
    has_place = np.isfinite(people).all(axis=-1) & (np.abs(people[..., :2]) <= FARTHEST_PX).all(axis=-1) & (people[..., 2] > 0)
    people[..., 2] = np.where(has_place, np.minimum(people[..., 2], 1.0), 0.0)
    people[..., :2][~has_place] = np.nan
    return people


def largest_confidence(rows: Sequence[Float[np.ndarray, "keypoint 3"]]) -> float | None:
    """Return the largest confidence of some people, if it is above 1."""
    values = [float(np.nanmax(row[:, 2])) for row in rows if np.isfinite(row[:, 2]).any()]
    return largest if (largest := max(values, default=0.0)) > 1.0 else None
