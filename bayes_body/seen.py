"""What cameras say of a frame, as the likelihoods that are distributions over it read it: markers in the image, silhouettes on a grid.

Such data can be made of a recording (observation/) as well as drawn from a model (`Factor.simulate`).
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Array, Bool, Float

# The markers that `SeenMarkers` has a place for: those that errors are measured on (recording/truth.py has the same, in the same order).
MARKERS = (
    *("pelvis", "thorax", "l_shoulder", "l_elbow", "l_wrist", "r_shoulder", "r_elbow", "r_wrist"),
    *("l_hip", "l_knee", "l_ankle", "r_hip", "r_knee", "r_ankle", "head"),
)
# Columns and rows at which silhouettes are looked at, where nothing else is said.
GRID = (64, 48)


class SeenMarkers(NamedTuple):
    """Where each camera sees the markers, in the order of `MARKERS`.

    Attributes:
        pixels: column, row; 0, 0 where a marker is not seen.
        confidence: between 0 and 1; 0 where a marker is not seen.
    """

    pixels: Float[Array | np.ndarray, "camera marker 2"]
    confidence: Float[Array | np.ndarray, "camera marker"]


class SeenSilhouettes(NamedTuple):
    """The subject's silhouette in each camera, looked at in a grid of pixels.

    Attributes:
        foreground: whether the pixel at a point of the grid is the subject's.
        seen: whether the camera saw the frame; where it did not, its foreground says nothing.
    """

    foreground: Bool[Array | np.ndarray, "camera row column"]
    seen: Bool[Array | np.ndarray, " camera"]
