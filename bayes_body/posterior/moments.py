r"""Mean, standard deviation and quantiles of weighted draws.

$\bar x = \sum_i w_i x_i$, $s^2 = \sum_i w_i (x_i - \bar x)^2$, and the quantile q is the smallest draw up to which the weights sum to q. Quantiles
are exact, without interpolation.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

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


def weighted_moments(values: Float[np.ndarray, "frame draw *of"], weights: Float[np.ndarray, "frame draw"]) -> Moments:
    """Return the moments over the draws of each frame.

    Args:
        values: one quantity of any shape for each draw.
        weights: their weights, which sum to one in each frame.
    """
    flat = values.reshape(*values.shape[:2], -1)
    mean = np.einsum("fs,fsk->fk", weights, flat)
    sd = np.sqrt(np.einsum("fs,fsk->fk", weights, (flat - mean[:, None]) ** 2))
    moments = (mean, sd, *weighted_quantiles(flat, weights, (0.05, 0.95)))
    return Moments(*(moment.reshape(values.shape[0], *values.shape[2:]) for moment in moments))


def weighted_quantiles(
    values: Float[np.ndarray, "frame draw k"], weights: Float[np.ndarray, "frame draw"], shares: tuple[float, ...]
) -> Float[np.ndarray, "share frame k"]:
    """Return the quantiles: for each probability in `shares` (above 0), the smallest draw up to which the weights sum to it; NaN where a draw is NaN.

    Raises:
        ValueError: the weights of a frame are all zero, or not finite.
    """
    at = np.subtract(shares, ROUNDING)
    # Frame by frame: one-dimensional weights apply to all columns, and only one frame is sorted at a time.
    each = [np.quantile(frame, at, axis=0, weights=own, method="inverted_cdf") for frame, own in zip(values, weights, strict=True)]
    return np.stack(each, axis=1)


def unwrapped(angles: Float[np.ndarray, "frame draw k"], weights: Float[np.ndarray, "frame draw"]) -> Float[np.ndarray, "frame draw k"]:
    """Return angles (radians) shifted by full turns to within half a turn of their weighted circular mean.

    Full turns in single draws then do not change the moments. The circular mean is taken on the turn nearest to the arithmetic mean, so an angle that
    keeps turning from frame to frame keeps its turns.
    """
    direction = np.einsum("fs,fsk->fk", weights, np.exp(1j * angles))
    centre = np.angle(direction)
    plain = np.einsum("fs,fsk->fk", weights, angles)
    centre += 2 * np.pi * np.round((plain - centre) / (2 * np.pi))
    difference = angles - centre[:, None]
    return centre[:, None] + difference - 2 * np.pi * np.round(difference / (2 * np.pi))
