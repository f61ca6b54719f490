"""Marker positions in the images of one frame: what an observation writes and the marker likelihood reads.

Such data can come from a recording (observation/) or be simulated by a model (`Factor.simulate`).
"""

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
from jaxtyping import Array, Float

# The 15 markers with which errors are measured, in the order of every array that holds them all; "head" is the last.
MARKERS = (
    *("pelvis", "thorax", "l_shoulder", "l_elbow", "l_wrist", "r_shoulder", "r_elbow", "r_wrist"),
    *("l_hip", "l_knee", "l_ankle", "r_hip", "r_knee", "r_ankle", "head"),
)
# Keypoints of the feet, which show how the ankles bend. No truth has them.
FEET = ("l_heel", "l_big_toe", "l_small_toe", "r_heel", "r_big_toe", "r_small_toe")
KEYPOINTS = (*MARKERS, *FEET)


class MarkerEvidence(NamedTuple):
    """What each camera sees of the markers of a body, in the order of `evidence_names`.

    Attributes:
        pixels: column, row; 0, 0 where a marker is not seen.
        confidence: between 0 and 1; 0 where a marker is not seen.
    """

    pixels: Float[Array | np.ndarray, "camera marker 2"]
    confidence: Float[Array | np.ndarray, "camera marker"]


class CandidateEvidence(NamedTuple):
    """What each camera sees of the markers of a body, where it sees several people: alternatives, of which at most one is the body's.

    Attributes:
        pixels: column, row; 0, 0 where a marker is not seen.
        confidence: between 0 and 1; 0 where a marker is not seen.
        shares: the probability that a candidate is the body's, before the body's pose is looked at. What is missing to 1 in a camera is the
            probability that none is.
    """

    pixels: Float[Array | np.ndarray, "camera candidate marker 2"]
    confidence: Float[Array | np.ndarray, "camera candidate marker"]
    shares: Float[Array | np.ndarray, "camera candidate"]


def evidence_names(markers: Iterable[str]) -> tuple[str, ...]:
    """Return the names in the order of the evidence of a body with these markers: `MARKERS`, and `KEYPOINTS` if it has markers on its feet."""
    return MARKERS if set(FEET).isdisjoint(markers) else KEYPOINTS
