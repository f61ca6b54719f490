r"""Mean, standard deviation and quantiles of weighted draws.

$\bar x = \sum_i w_i x_i$, $s^2 = \sum_i w_i (x_i - \bar x)^2$, and the quantile q is the smallest draw up to which the weights sum to q. Quantiles
are exact, without interpolation.
"""

from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from bayes_body.density.spaces import Space

# A cumulative sum of weights can miss a probability by rounding errors: without this, 19 of 20 equal weights might not reach 0.95.
ROUNDING = 1e-12


class Moments(NamedTuple):
    """Moments of a quantity in each frame: arrays of the same shape (frame, ...), in the quantity's unit.

    Attributes:
        mean: weighted mean.
        sd: weighted standard deviation.
        q05: 0.05 quantile.
        q95: 0.95 quantile.
    """

    mean: Float[np.ndarray, "frame ..."]
    sd: Float[np.ndarray, "frame ..."]
    q05: Float[np.ndarray, "frame ..."]
    q95: Float[np.ndarray, "frame ..."]


class MomentsAndMedian(NamedTuple):
    """The moments, and the median after them."""

    mean: Float[np.ndarray, "frame ..."]
    sd: Float[np.ndarray, "frame ..."]
    q05: Float[np.ndarray, "frame ..."]
    q95: Float[np.ndarray, "frame ..."]
    q50: Float[np.ndarray, "frame ..."]

    @property
    def moments(self) -> Moments:
        """Return the moments without the median."""
        return Moments(*self[:4])


def weighted_moments(values: Float[np.ndarray, "frame draw *of"], weights: Float[np.ndarray, "frame draw"]) -> Moments:
    """Return the moments over the draws of each frame.

    Args:
        values: one quantity of any shape for each draw.
        weights: their weights, which sum to one in each frame.
    """
    return Moments(*_moments(values, weights, (0.05, 0.95)))


def moments_and_median(values: Float[np.ndarray, "frame draw *of"], weights: Float[np.ndarray, "frame draw"]) -> MomentsAndMedian:
    """Return the moments and the median over the draws of each frame. The arguments are those of `weighted_moments`."""
    return MomentsAndMedian(*_moments(values, weights, (0.05, 0.95, 0.5)))


def _moments(
    values: Float[np.ndarray, "frame draw *of"], weights: Float[np.ndarray, "frame draw"], shares: tuple[float, ...]
) -> Iterator[Float[np.ndarray, "frame *of"]]:
    flat = values.reshape(*values.shape[:2], -1)
    mean = np.einsum("fs,fsk->fk", weights, flat)
    sd = np.sqrt(np.einsum("fs,fsk->fk", weights, (flat - mean[:, None]) ** 2))
    for moment in (mean, sd, *weighted_quantiles(flat, weights, shares)):
        yield moment.reshape(values.shape[0], *values.shape[2:])


def moments_in[M: (Moments, MomentsAndMedian)](
    space: Space,
    points: Float[np.ndarray, "frame draw *shape"],
    weights: Float[np.ndarray, "frame draw"],
    statistic: Callable[[Float[np.ndarray, "frame draw dimension"], Float[np.ndarray, "frame draw"]], M] = weighted_moments,
) -> M:
    """Return the moments of a variable over the draws of each frame, in its space's coordinates around the mean: (frame, dimension).

    For numbers they are those of the numbers. Angles on the circle are first brought within half a turn of their mean, on the turn nearest to the
    arithmetic mean: full turns in single draws do not change the moments, and an angle that keeps turning from frame to frame keeps its turns. A
    rotation has a rotation vector relative to its mean, so the mean's own entries are 0.

    Args:
        space: where the variable lives.
        points: one point for each draw.
        weights: as for `weighted_moments`.
        statistic: `weighted_moments` or `moments_and_median`.
    """
    mean = np.asarray(space.mean(weights, points))
    return statistic(np.asarray(space.coordinates(mean[:, None], points)), weights)


def weighted_quantiles(
    values: Float[np.ndarray, "frame draw k"], weights: Float[np.ndarray, "frame draw"], shares: tuple[float, ...]
) -> Float[np.ndarray, "share frame k"]:
    """Return the quantiles: for each probability in `shares` (above 0), the smallest draw up to which the weights sum to it; NaN where a draw is NaN.

    Raises:
        ValueError: the weights of a frame are all zero, or not finite.
    """
    levels = np.subtract(shares, ROUNDING)
    # Frame by frame: one-dimensional weights apply to all columns, and only one frame is sorted at a time.
    quantiles = [
        np.quantile(frame, levels, axis=0, weights=frame_weights, method="inverted_cdf") for frame, frame_weights in zip(values, weights, strict=True)
    ]
    return np.stack(quantiles, axis=1)
