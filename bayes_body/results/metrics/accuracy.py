r"""Error and coverage of one frame's weighted markers, compared with the truth.

Consider one marker, with particles $x_i$ of weights $w_i$ and the truth $z$. The error is $\|\sum_i w_i x_i - z\|$. For each axis, the equal-tailed
interval of level L reaches from the quantile $(1-L)/2$ to $(1+L)/2$, where the quantile p is the smallest particle up to which the weights sum to p
(`posterior.moments`). The truth is inside, ends included, if and only if

$$\sum_i w_i [x_i \le z] \ge \tfrac{1-L}{2} \quad\text{and}\quad \sum_i w_i [x_i < z] < \tfrac{1+L}{2},$$

The same two sums are used for all levels, without sorting. If the truth and n particles of equal weight are drawn from the same distribution, the
truth is inside with a probability that differs from L by at most $1/(n+1)$.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from numpy.typing import NDArray

from bayes_body.results.posterior.moments import ROUNDING, weighted_quantiles

LEVELS = (0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9)
# Probabilities of the quantiles of the error that a run expects: the ends of its central 90 % and 50 %.
SHARES = (0.05, 0.25, 0.75, 0.95)
# The marker relative to which others are measured.
ORIGIN = "pelvis"


class FrameAccuracy(NamedTuple):
    """One frame of one run compared with the truth, metres; NaN where the truth is unknown.

    Attributes:
        off: vector from the weighted mean marker to the true one.
        relative: mean error of all markers except the pelvis, after mean and truth are each shifted to their own pelvis.
        optimistic: smallest mean distance of a single particle's markers from the truth. The best particle cannot be known without the truth.
        inside: whether the truth is inside the interval of each of LEVELS; False where it is unknown.
        expected: quantiles, at SHARES, of the mean distance of a particle's markers from the mean markers. If the truth is another draw from the
            posterior, the error has these quantiles.
    """

    off: Float[np.ndarray, "marker 3"]
    relative: float
    optimistic: float
    inside: Bool[np.ndarray, "level marker 3"]
    expected: Float[np.ndarray, " share"]

    @property
    def error(self) -> Float[np.ndarray, " marker"]:
        """Distance of the weighted mean marker from the true one."""
        return _distances(self.off, np.zeros(3))


def frame_accuracy(
    positions: Float[np.ndarray, "particle marker 3"],
    weights: Float[np.ndarray, " particle"],
    truth: Float[np.ndarray, "marker 3"],
    names: tuple[str, ...],
) -> FrameAccuracy:
    """Compare one frame of one run with the truth.

    Args:
        positions: positions of the particles' markers, metres.
        weights: weights of the particles; they sum to one.
        truth: true positions of the same markers, metres; a marker is unknown if any of its numbers is NaN.
        names: names of the markers.
    """
    is_measured = np.isfinite(truth).all(axis=-1)
    off, inside = np.full(truth.shape, np.nan), np.zeros((len(LEVELS), *truth.shape), bool)
    if not is_measured.any():
        return FrameAccuracy(off, float("nan"), float("nan"), inside, np.full(len(SHARES), np.nan))
    cloud, true = (positions if is_measured.all() else positions[:, is_measured]), truth[is_measured]
    mean = (weights @ cloud.reshape(len(cloud), -1)).reshape(-1, 3)
    off[is_measured] = true - mean
    inside[:, is_measured] = inside_intervals(cloud, weights, true)
    optimistic = _distances(cloud, true).mean(axis=1)[weights > 0].min()
    spread = _distances(cloud, mean).mean(axis=1)
    expected = weighted_quantiles(spread[None, :, None], weights[None], SHARES).ravel()
    relative = _relative(off[is_measured], tuple(name for name, is_known in zip(names, is_measured, strict=True) if is_known))
    return FrameAccuracy(off, relative, float(optimistic), inside, expected)


def inside_intervals(
    cloud: Float[np.ndarray, "particle marker axis"], weights: Float[np.ndarray, " particle"], truth: Float[np.ndarray, "marker axis"]
) -> Bool[np.ndarray, "level marker axis"]:
    """Return whether the truth lies inside the weighted equal-tailed interval of each of LEVELS, for each axis separately."""
    below, up_to = (weights @ side.reshape(len(cloud), -1) for side in (cloud < truth, cloud <= truth))
    ends = [((1 - level) / 2 - ROUNDING, (1 + level) / 2 - ROUNDING) for level in LEVELS]
    return np.stack([(up_to >= low) & (below < high) for low, high in ends]).reshape(-1, *truth.shape)


def _relative(off: Float[np.ndarray, "marker 3"], names: tuple[str, ...]) -> float:
    """Return the mean error after the pelvises are aligned; the pelvis itself is left out."""
    if ORIGIN not in names or len(names) == 1:
        return float("nan")
    place = names.index(ORIGIN)
    return float(_distances(np.delete(off, place, axis=0), off[place]).mean())


def _distances(points: NDArray[np.floating], target: NDArray[np.floating]) -> NDArray[np.floating]:
    # Several times as fast as numpy.linalg.norm over an axis of three.
    square = points - target
    square *= square
    return np.sqrt(square[..., 0] + square[..., 1] + square[..., 2])
