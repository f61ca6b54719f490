"""The particles of a recording, frame by frame, as they are compared with the truth."""

from collections.abc import Callable, Iterable
from typing import NamedTuple

import numpy as np
from jaxtyping import Float


class Cloud(NamedTuple):
    """The particles of one frame: poses in radians and metres, or values of another variable that places the body, and their log-weights."""

    poses: Float[np.ndarray, "run particle *shape"]
    log_weights: Float[np.ndarray, "run particle"]


type Clouds = Callable[[], Iterable[Cloud]]


def weights_of(log_weights: Float[np.ndarray, " particle"]) -> Float[np.ndarray, " particle"]:
    """Return the weights, which sum to one."""
    weights = np.exp(log_weights.astype(float) - log_weights.max())
    return weights / weights.sum()
