"""Silhouettes of one frame on a grid of pixels: what an observation writes and the silhouette likelihood reads.

Such data can come from a recording (observation/) or be simulated by a model (`Factor.simulate`).
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Array, Bool

# Default columns and rows of the grid.
GRID = (64, 48)


class SilhouetteEvidence(NamedTuple):
    """The subject's silhouette in each camera, sampled on a grid of pixels.

    Attributes:
        foreground: whether the pixel at a grid point belongs to the subject.
        has_image: whether the camera saw the frame; if not, its foreground means nothing.
        uncovered: whether no other person covers the pixel at a grid point; None where no camera sees other people.
    """

    foreground: Bool[Array | np.ndarray, "camera row column"]
    has_image: Bool[Array | np.ndarray, " camera"]
    uncovered: Bool[Array | np.ndarray, "camera row column"] | None = None
