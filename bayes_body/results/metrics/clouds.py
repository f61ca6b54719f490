"""The particles of a recording, frame by frame, as they are compared with the truth."""

from collections.abc import Callable, Iterable, Mapping
from types import MappingProxyType
from typing import NamedTuple

import numpy as np
from jaxtyping import Float


class Cloud(NamedTuple):
    """The particles of one frame.

    Attributes:
        poses: in radians and metres, or values of another variable that places the body.
        log_weights: their log-weights.
        changes: values of the unknowns that change the body (`Model.placing`), by name.
    """

    poses: Float[np.ndarray, "run particle *shape"]
    log_weights: Float[np.ndarray, "run particle"]
    changes: Mapping[str, Float[np.ndarray, "run particle entry"]] = MappingProxyType({})


type Clouds = Callable[[], Iterable[Cloud]]


def weights_of(log_weights: Float[np.ndarray, " particle"]) -> Float[np.ndarray, " particle"]:
    """Return the weights, which sum to one."""
    weights = np.exp(log_weights.astype(float) - log_weights.max())
    return weights / weights.sum()
