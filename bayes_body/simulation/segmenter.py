"""Silhouettes as a segmenter finds them.

A good one errs by a pixel or two along the outline; a poor one leaves holes, takes shadows along and sees blobs where nothing is.
"""

from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Bool, Float

from bayes_body.simulation.options import Quality

type Levels = Float[np.ndarray, "row column"]


class Faults(NamedTuple):
    """What a segmenter gets wrong.

    Attributes:
        soft_px: over how many pixels the person's edge is smeared before it is cut.
        outline: standard deviation of what is added before the cut at one half.
        outline_px: over how many pixels that varies.
        shadow: how much of a shadow counts as person.
        holes: standard deviations beyond which a slowly varying field tears a hole; and the same for a blob that is not there.
        blobs: see `holes`.
    """

    soft_px: float
    outline: float
    outline_px: float
    shadow: float
    holes: float
    blobs: float


FAULTS: dict[str, Faults] = {
    "good": Faults(soft_px=1.2, outline=0.35, outline_px=5, shadow=0.0, holes=np.inf, blobs=np.inf),
    "poor": Faults(soft_px=2.5, outline=0.45, outline_px=10, shadow=0.9, holes=1.6, blobs=3.0),
}
# Pixels over which a hole and a blob extend; this and all pixels here are those of a picture of 640 columns.
HOLE_PX, BLOB_PX, AT_COLUMNS = 22, 16, 640


def segment(rng: np.random.Generator, quality: Quality, coverage: Levels, shadow: Levels) -> Bool[np.ndarray, "row column"]:
    """The silhouette that a segmenter of a quality gives.

    Args:
        rng: what it gets wrong.
        quality: `good` or `poor`.
        coverage: share of each pixel that the person covers.
        shadow: how dark the person's shadow is, from 0 to 1.
    """
    faults, scale = FAULTS[quality], coverage.shape[1] / AT_COLUMNS
    person = np.maximum(coverage, faults.shadow * shadow) if faults.shadow else coverage
    if np.isfinite(faults.holes):
        person = person * (_field(rng, coverage.shape, HOLE_PX * scale) < faults.holes)
    if np.isfinite(faults.blobs):
        person = np.maximum(person, _field(rng, coverage.shape, BLOB_PX * scale) > faults.blobs)
    soft = cv2.GaussianBlur(person.astype(np.float32), (0, 0), faults.soft_px * scale)
    return soft + faults.outline * _field(rng, coverage.shape, faults.outline_px * scale) * (4 * soft * (1 - soft)) > 0.5


def _field(rng: np.random.Generator, shape: tuple[int, ...], cell_px: float) -> Levels:
    """Values of mean 0 and standard deviation near 1 that vary over `cell_px` pixels."""
    rows, columns = (int(side / cell_px) + 3 for side in shape[:2])
    coarse = rng.standard_normal((rows, columns), dtype=np.float32)
    # Between the cells' middles a cubic loses some of the spread.
    return 1.25 * cv2.resize(coarse, (shape[1], shape[0]), interpolation=cv2.INTER_CUBIC)
