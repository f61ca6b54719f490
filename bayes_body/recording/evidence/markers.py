"""Marker positions in the images of one frame: what an observation writes and the marker likelihood reads.

Such data can come from a recording (observation/) or be simulated by a model (`Factor.simulate`).
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Array, Float

# The 15 markers with which errors are measured, in the order of every array that holds them all; "head" is the last.
MARKERS = (
    *("pelvis", "thorax", "l_shoulder", "l_elbow", "l_wrist", "r_shoulder", "r_elbow", "r_wrist"),
    *("l_hip", "l_knee", "l_ankle", "r_hip", "r_knee", "r_ankle", "head"),
)


class MarkerEvidence(NamedTuple):
    """What each camera sees of the markers, in the order of `MARKERS`.

    Attributes:
        pixels: column, row; 0, 0 where a marker is not seen.
        confidence: between 0 and 1; 0 where a marker is not seen.
    """

    pixels: Float[Array | np.ndarray, "camera marker 2"]
    confidence: Float[Array | np.ndarray, "camera marker"]
