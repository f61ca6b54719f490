"""Silhouettes on a grid of pixels: what `silhouette_bernoulli` reads."""

from collections.abc import Callable
from typing import Any

import numpy as np
from jaxtyping import Bool
from numpy.typing import NDArray

from bayes_body.errors import input_error
from bayes_body.evidence.silhouettes import GRID, SilhouetteEvidence
from bayes_body.observation.frames import Frame
from bayes_body.registry import register
from bayes_body.toml.schema import Schema


class Options(Schema):
    """There is nothing to choose in `[likelihood.observation]` of `silhouette_bernoulli`: the grid is the likelihood's."""


def sample_mask(mask: NDArray[np.bool_], columns: int, rows: int) -> Bool[np.ndarray, "row column"]:
    """The pixels of a mask (height, width) in which the points of the grid lie that is stretched over it; any may be looked at several times."""
    row, column = ((2 * np.arange(count) + 1) * extent // (2 * count) for count, extent in zip((rows, columns), mask.shape, strict=True))
    return mask[np.ix_(row, column)]


@register("observation", "silhouette_bernoulli", Options)
def build(likelihood: Any = None, **_: Any) -> Callable[[Frame], SilhouetteEvidence]:
    """From a frame's masks to the likelihood's grids, as NumPy arrays.

    Args:
        likelihood: the options of the likelihood that reads them; its `grid` is taken.
    """
    columns, rows = getattr(likelihood, "grid", GRID)

    def observe(frame: Frame) -> SilhouetteEvidence:
        if frame.masks is None:
            expected = "a silhouette for every image"
            remedy = "give each [[camera]] its `masks`, or an image of the empty scene as `background`"
            raise input_error("session.toml", "its cameras have no masks, and the frames are too few to learn the background from", expected, remedy)
        masks = list(frame.masks)
        nothing = np.zeros((rows, columns), bool)
        grids = [nothing if mask is None else sample_mask(mask, columns, rows) for mask in masks]
        return SilhouetteEvidence(np.stack(grids), np.array([mask is not None for mask in masks]))

    return observe
