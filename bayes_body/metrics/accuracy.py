r"""How far one frame's weighted markers are from the truth, and whether their spread says so.

With particles $x_i$ of weights $w_i$ and the truth $z$, all of one marker: the error is $\|\sum_i w_i x_i - z\|$. Of one axis, the equal-tailed
interval of level L reaches from the quantile $(1-L)/2$ to $(1+L)/2$, where the quantile p is the smallest particle up to which the weights sum to p
(`posterior.moments`). The truth is inside, ends included, exactly if

$$\sum_i w_i [x_i \le z] \ge \tfrac{1-L}{2} \quad\text{and}\quad \sum_i w_i [x_i < z] < \tfrac{1+L}{2},$$

two sums that serve all levels, without sorting. If the truth is one more draw from what n particles of equal weight are drawn from, it is inside with
a probability that differs from L by at most $1/(n+1)$.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from numpy.typing import NDArray

from bayes_body.posterior.moments import ROUNDING, weighted_quantiles

LEVELS = (0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9)
# Of the distance that a run itself expects between its mean and the truth: the ends of its 90 % and of its 50 %.
SHARES = (0.05, 0.25, 0.75, 0.95)
# The marker that others are measured from.
ORIGIN = "pelvis"


class FrameAccuracy(NamedTuple):
    """One frame of one run against the truth, metres; NaN where the truth is unknown.

    Attributes:
        off: from the weighted mean marker to the true one.
        relative: mean of that distance over the markers but the pelvis, mean and truth shifted to their own pelvis.
        optimistic: least mean distance of a single particle's markers from the truth: of the best particle, which nobody knows without the truth.
        inside: whether the truth is inside the interval of each of LEVELS; False where it is unknown.
        expected: quantiles SHARES of the mean distance of a particle's markers from the mean's: of the error, if the truth is one more draw.
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
    """A frame of one run against the truth.

    Args:
        positions: of the particles' markers, metres.
        weights: of the particles; they sum to one.
        truth: of the same markers, metres; a marker is unknown if any of its numbers is NaN.
        names: of the markers.
    """
    known = np.isfinite(truth).all(axis=-1)
    off, inside = np.full(truth.shape, np.nan), np.zeros((len(LEVELS), *truth.shape), bool)
    if not known.any():
        return FrameAccuracy(off, float("nan"), float("nan"), inside, np.full(len(SHARES), np.nan))
    cloud, true = (positions if known.all() else positions[:, known]), truth[known]
    mean = (weights @ cloud.reshape(len(cloud), -1)).reshape(-1, 3)
    off[known] = true - mean
    inside[:, known] = inside_intervals(cloud, weights, true)
    optimistic = _distances(cloud, true).mean(axis=1)[weights > 0].min()
    spread = _distances(cloud, mean).mean(axis=1)
    expected = weighted_quantiles(spread[None, :, None], weights[None], SHARES).ravel()
    relative = _relative(off[known], tuple(name for name, is_known in zip(names, known, strict=True) if is_known))
    return FrameAccuracy(off, relative, float(optimistic), inside, expected)


def inside_intervals(
    cloud: Float[np.ndarray, "particle marker 3"], weights: Float[np.ndarray, " particle"], truth: Float[np.ndarray, "marker 3"]
) -> Bool[np.ndarray, "level marker 3"]:
    """Whether the truth lies inside the weighted equal-tailed interval of each of LEVELS, each axis by itself."""
    below, up_to = (weights @ side.reshape(len(cloud), -1) for side in (cloud < truth, cloud <= truth))
    ends = [((1 - level) / 2 - ROUNDING, (1 + level) / 2 - ROUNDING) for level in LEVELS]
    return np.stack([(up_to >= low) & (below < high) for low, high in ends]).reshape(-1, *truth.shape)


def _relative(off: Float[np.ndarray, "marker 3"], names: tuple[str, ...]) -> float:
    """What is left of the difference from the truth once the pelvises lie on each other; the pelvis, which then has none, does not count."""
    if ORIGIN not in names or len(names) == 1:
        return float("nan")
    place = names.index(ORIGIN)
    return float(_distances(np.delete(off, place, axis=0), off[place]).mean())


def _distances(points: NDArray[np.floating], target: NDArray[np.floating]) -> NDArray[np.floating]:
    # Several times as fast as numpy.linalg.norm over an axis of three.
    square = points - target
    square *= square
    return np.sqrt(square[..., 0] + square[..., 1] + square[..., 2])
