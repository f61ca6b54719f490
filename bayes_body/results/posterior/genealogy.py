"""Particle genealogy: the number of particles of an earlier frame that have descendants in a frame.

Resampling reduces the number of ancestors: all particles of a frame descend from a single particle some frames before. The fewer frames this takes,
the more similar are the particles' histories.
"""

from collections.abc import Iterator
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float, Int

from bayes_body.density.kernel import NO_ANCESTOR
from bayes_body.results.posterior.blocks import BLOCK, LARGEST, pieces

if TYPE_CHECKING:
    import xarray as xr


def unique_ancestors(tree: "xr.DataTree", lags: tuple[int, ...]) -> Float[np.ndarray, "lag run frame"]:
    """Return the number of particles `lag` frames before a frame that have descendants in it; NaN if there is no such frame, or no ancestor.

    Lag 1 counts the particles that the frame's own resampling kept. Before the first frame all particles have the same pose.
    """
    ancestor = tree["sample_stats"]["ancestor"]
    runs, draws, frames = (ancestor.sizes[name] for name in ("chain", "draw", "frame"))
    out = np.full((len(lags), runs, frames), np.nan)
    for piece in pieces(range(frames), min(BLOCK, LARGEST // (runs * draws))):
        first = max(piece.start - max(lags) + 1, 0)
        ancestors = np.asarray(ancestor.isel(frame=slice(first, piece.stop))).transpose(0, 2, 1)
        for lag, lineage in _lineages(ancestors, piece.start - first, max(lags)):
            if lag in lags:
                out[lags.index(lag), :, piece.stop - lineage.shape[1] : piece.stop] = _distinct(lineage)
    return out


def _lineages(ancestors: Int[np.ndarray, "run frame draw"], start: int, most: int) -> Iterator[tuple[int, Int[np.ndarray, "run some draw"]]]:
    """Yield, for each lag, the ancestors of the particles of frame `start` and later. Frames whose ancestors are unknown are left out."""
    lineage = ancestors[:, start:]
    yield 1, lineage
    for lag in range(2, most + 1):
        lost = max(lag - 1 - start, 0)
        if lost >= ancestors.shape[1] - start:
            return
        earlier_ancestors = ancestors[:, start + lost - lag + 1 : ancestors.shape[1] - lag + 1]
        lineage = lineage[:, lineage.shape[1] - earlier_ancestors.shape[1] :]
        lineage = np.where(lineage == NO_ANCESTOR, NO_ANCESTOR, np.take_along_axis(earlier_ancestors, lineage, axis=2))
        yield lag, lineage


def _distinct(lineage: Int[np.ndarray, "run frame draw"]) -> Float[np.ndarray, "run frame"]:
    ordered = np.sort(lineage, axis=2)
    count = 1.0 + (np.diff(ordered, axis=2) != 0).sum(axis=2)
    return np.where(ordered[:, :, 0] == NO_ANCESTOR, np.nan, count)
