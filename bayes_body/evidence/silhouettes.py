"""Silhouettes of one frame on a grid of pixels: what an observation writes and the silhouette likelihood reads.

Such data can be made from a recording (observation/) as well as drawn from a model (`Factor.simulate`).
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Array, Bool

# Columns and rows of the grid, unless a definition says otherwise.
GRID = (64, 48)


class SilhouetteEvidence(NamedTuple):
    """The subject's silhouette in each camera, sampled on a grid of pixels.

    Attributes:
        foreground: whether the pixel at a point of the grid is the subject's.
        seen: whether the camera saw the frame; where it did not, its foreground says nothing.
    """

    foreground: Bool[Array | np.ndarray, "camera row column"]
    seen: Bool[Array | np.ndarray, " camera"]
