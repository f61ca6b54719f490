r"""Scores of one frame's weighted markers against the truth: calibration by distance, CRPS, spread, and a rank for the joint distribution.

Consider draws $x_i$ of weights $w_i$ and the truth $z$.

- **Radial level** of a marker: $\sum_i w_i [\|x_i - m\| < \|z - m\|]$ around the coordinate median m. The truth lies within the weighted
  quantile of the distances at level L if and only if its level is below L (Pierzchlewicz et al. 2022, arXiv:2210.11179).
- **CRPS** of a coordinate: $\sum_i w_i |x_i - z| - \tfrac12 \sum_{ij} w_i w_j |x_i - x_j| / (1 - \sum_i w_i^2)$, in the unit of the coordinate.
  For equal weights this is the fair form: its mean does not depend on the number of draws (Ferro 2014).
- **TARP rank** of all markers together: $\sum_i w_i [\|x_i - \theta\| < \|z - \theta\|]$ for a random reference point $\theta$ (Lemos et al. 2023,
  Sampling-based accuracy testing of posterior estimators for general inference). The reference is the mean plus normal noise with the draws'
  standard deviation of each coordinate. It depends on the draws only, so the ranks of a calibrated posterior are uniform. It is near the mean, so
  ranks above one half mean that the posterior is too narrow, or beside the truth.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from bayes_body.results.posterior.moments import ROUNDING


class FrameScores(NamedTuple):
    """Scores of one frame of one run; NaN where the truth is unknown.

    Attributes:
        level: radial level of each marker, between 0 and 1.
        crps: CRPS of each marker, mean over the axes, metres.
        spread: root mean square distance of each marker's draws from their mean, metres.
        rank: TARP rank of all known markers together, between 0 and 1.
    """

    level: Float[np.ndarray, " marker"]
    crps: Float[np.ndarray, " marker"]
    spread: Float[np.ndarray, " marker"]
    rank: float


def frame_scores(
    positions: Float[np.ndarray, "particle marker 3"],
    weights: Float[np.ndarray, " particle"],
    truth: Float[np.ndarray, "marker 3"],
    noise: Float[np.ndarray, "marker 3"],
) -> FrameScores:
    """Score one frame of one run.

    Args:
        positions: positions of the particles' markers, metres.
        weights: weights of the particles; they sum to one.
        truth: true positions of the same markers, metres; a marker is unknown if any of its numbers is NaN.
        noise: standard normal numbers, from which the reference point is made.
    """
    is_measured = np.isfinite(truth).all(axis=-1)
    level, crps, spread = (np.full(len(truth), np.nan) for _ in range(3))
    if not is_measured.any():
        return FrameScores(level, crps, spread, float("nan"))
    # One row a coordinate, so that sums over the draws are over neighbouring numbers.
    draws = np.ascontiguousarray(np.moveaxis(positions[:, is_measured], 0, -1), np.float64)
    true = truth[is_measured, :, None]
    order = np.argsort(draws, axis=-1)
    ordered, steps = np.take_along_axis(draws, order, axis=-1), np.cumsum(weights[order], axis=-1)
    median = np.take_along_axis(ordered, (steps < 0.5 - ROUNDING).sum(axis=-1, keepdims=True), axis=-1)
    crps[is_measured] = (np.abs(draws - true) @ weights - _half_difference(ordered, steps, weights)).mean(axis=-1)
    level[is_measured] = (_squared(draws - median) < _squared(true - median)) @ weights
    mean = (draws @ weights)[..., None]
    variance = (draws - mean) ** 2 @ weights
    spread[is_measured] = np.sqrt(variance.sum(axis=-1))
    reference = mean + (np.sqrt(variance) * noise[is_measured])[..., None]
    nearer = _squared(draws - reference).sum(axis=0) < _squared(true - reference).sum(axis=0)
    return FrameScores(level, crps, spread, float(nearer @ weights))


def _half_difference(
    ordered: Float[np.ndarray, "*of particle"], steps: Float[np.ndarray, "*of particle"], weights: Float[np.ndarray, " particle"]
) -> Float[np.ndarray, "*of"]:
    r"""Return half the mean difference of two draws, $\int F (1 - F)$ of the weighted distribution, over the probability that they differ."""
    between = (np.diff(ordered, axis=-1) * (steps * (1 - steps))[..., :-1]).sum(axis=-1)
    return between / max(1 - float(weights @ weights), ROUNDING)


def _squared(vectors: Float[np.ndarray, "marker 3 particle"]) -> Float[np.ndarray, "marker particle"]:
    return np.einsum("mip,mip->mp", vectors, vectors)
