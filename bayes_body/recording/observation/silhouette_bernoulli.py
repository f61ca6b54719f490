"""Silhouettes on a grid of pixels: what `silhouette_bernoulli` reads."""

from collections.abc import Callable
from typing import Any

import numpy as np
from jaxtyping import Bool
from numpy.typing import NDArray

from bayes_body.base.registry import register
from bayes_body.base.toml.schema import Schema
from bayes_body.recording.evidence.silhouettes import GRID, SilhouetteEvidence
from bayes_body.recording.observation.frames import Frame, masks_of


class Options(Schema):
    """`[likelihood.observation]` of `silhouette_bernoulli` has no options: the grid is the likelihood's."""


def sample_mask(mask: NDArray[np.bool_], columns: int, rows: int) -> Bool[np.ndarray, "row column"]:
    """The mask (height, width) sampled at the points of a grid stretched over it. A fine grid may read a pixel several times."""
    row, column = ((2 * np.arange(count) + 1) * extent // (2 * count) for count, extent in zip((rows, columns), mask.shape, strict=True))
    return mask[np.ix_(row, column)]


@register("observation", "silhouette_bernoulli", Options)
def build(likelihood: Any = None, **_: Any) -> Callable[[Frame], SilhouetteEvidence]:
    """Sample the likelihood's grids from a frame's masks, as NumPy arrays.

    Args:
        likelihood: the options of the likelihood that reads them; its `grid` is used.
    """
    columns, rows = getattr(likelihood, "grid", GRID)

    def observe(frame: Frame) -> SilhouetteEvidence:
        masks = list(masks_of(frame))
        empty_mask = np.zeros((rows, columns), bool)
        grids = [empty_mask if mask is None else sample_mask(mask, columns, rows) for mask in masks]
        has_image = np.array([mask is not None for mask in masks])
        if frame.covered is None:
            return SilhouetteEvidence(np.stack(grids), has_image)
        regions = [empty_mask if region is None else sample_mask(region, columns, rows) for region in frame.covered]
        return SilhouetteEvidence(np.stack(grids), has_image, ~np.stack(regions))

    return observe
