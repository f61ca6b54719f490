r"""Mean, standard deviation and quantiles of weighted draws.

$\bar x = \sum_i w_i x_i$, $s^2 = \sum_i w_i (x_i - \bar x)^2$, and the quantile q is the smallest draw up to which the weights sum to q: exact,
without interpolation. Weights sum to one.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

# A cumulated sum of weights ends some rounding errors below 1.
ROUNDING = 1e-12


class Moments(NamedTuple):
    """What is known of a quantity, frame by frame: arrays of one shape (frame, ...), in the quantity's unit.

    Attributes:
        mean: weighted mean.
        sd: weighted standard deviation.
        q05: the quantile 0.05.
        q95: the quantile 0.95.
    """

    mean: Float[np.ndarray, "frame ..."]
    sd: Float[np.ndarray, "frame ..."]
    q05: Float[np.ndarray, "frame ..."]
    q95: Float[np.ndarray, "frame ..."]


def weighted_moments(values: Float[np.ndarray, "frame draw *of"], weights: Float[np.ndarray, "frame draw"]) -> Moments:
    """Moments over the draws of each frame.

    Args:
        values: one quantity, of any shape, a draw.
        weights: their weights, which sum to one in each frame.
    """
    flat = values.reshape(*values.shape[:2], -1)
    mean = np.einsum("fs,fsk->fk", weights, flat)
    sd = np.sqrt(np.einsum("fs,fsk->fk", weights, (flat - mean[:, None]) ** 2))
    moments = (mean, sd, *weighted_quantiles(flat, weights, (0.05, 0.95)))
    return Moments(*(moment.reshape(values.shape[0], *values.shape[2:]) for moment in moments))


def weighted_quantiles(
    values: Float[np.ndarray, "frame draw k"], weights: Float[np.ndarray, "frame draw"], shares: tuple[float, ...]
) -> list[Float[np.ndarray, "frame k"]]:
    """For each share the smallest draw up to which the weights sum to it."""
    order = np.argsort(values, axis=1)
    cumulative = np.cumsum(np.take_along_axis(weights[:, :, None], order, axis=1), axis=1)
    places = [np.argmax(cumulative >= share - ROUNDING, axis=1) for share in shares]
    chosen = [np.take_along_axis(order, place[:, None], axis=1) for place in places]
    return [np.take_along_axis(values, choice, axis=1)[:, 0] for choice in chosen]


def unwrapped(angles: Float[np.ndarray, "frame draw k"], weights: Float[np.ndarray, "frame draw"]) -> Float[np.ndarray, "frame draw k"]:
    """Angles (radians) each within half a turn of their weighted circular mean, on that turn on which their plain mean is.

    A full turn more or less then changes no moment, and an angle that winds on from frame to frame keeps its turns.
    """
    direction = np.einsum("fs,fsk->fk", weights, np.exp(1j * angles))
    centre = np.angle(direction)
    plain = np.einsum("fs,fsk->fk", weights, angles)
    centre += 2 * np.pi * np.round((plain - centre) / (2 * np.pi))
    difference = angles - centre[:, None]
    return centre[:, None] + difference - 2 * np.pi * np.round(difference / (2 * np.pi))
