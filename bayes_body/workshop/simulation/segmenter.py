"""Simulated errors of a segmenter's silhouettes.

A good segmenter errs by a pixel or two along the outline. A poor one leaves holes, includes shadows and adds blobs in empty regions.
"""

from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Bool, Float

from bayes_body.workshop.simulation.options import Quality

type Levels = Float[np.ndarray, "row column"]


class Faults(NamedTuple):
    """The errors of a segmenter.

    Attributes:
        soft_px: number of pixels over which the person's edge is smoothed before thresholding.
        outline: standard deviation of the noise that is added before thresholding at one half.
        outline_px: correlation length of that noise.
        shadow: weight of a shadow as part of the person.
        holes: a slowly varying field causes a hole where it exceeds this many standard deviations.
        blobs: the same for a blob that is not there.
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
# Size in pixels of a hole and of a blob. This and all pixels here refer to a picture with 640 columns.
HOLE_PX, BLOB_PX, AT_COLUMNS = 22, 16, 640


def segment(rng: np.random.Generator, quality: Quality, coverage: Levels, shadow: Levels) -> Bool[np.ndarray, "row column"]:
    """The silhouette that a segmenter of some quality returns.

    Args:
        rng: for its errors.
        quality: `good` or `poor`.
        coverage: fraction of each pixel that the person covers.
        shadow: darkness of the person's shadow, from 0 to 1.
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
    """Random values with mean 0 and standard deviation near 1, correlated over `cell_px` pixels."""
    rows, columns = (int(side / cell_px) + 3 for side in shape[:2])
    coarse = rng.standard_normal((rows, columns), dtype=np.float32)
    # Cubic interpolation between cells loses some of the standard deviation.
    return 1.25 * cv2.resize(coarse, (shape[1], shape[0]), interpolation=cv2.INTER_CUBIC)
