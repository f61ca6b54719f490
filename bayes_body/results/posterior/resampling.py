"""Systematic resampling on the host: draws of equal weight from weighted draws, for methods that do not use weights."""

import numpy as np
from jaxtyping import Float, Int

# The seed is fixed, so that a saved run always gives the same figures.
RESAMPLING_SEED = 0


def systematic_resampling(rng: np.random.Generator, weights: Float[np.ndarray, " draw"], count: int) -> Int[np.ndarray, " count"]:
    """Return the indices of `count` draws of equal weight in random order; the weights need not sum to one."""
    cumulative = np.cumsum(weights)
    levels = (np.arange(count) + rng.random()) / count * cumulative[-1]
    return rng.permutation(np.minimum(np.searchsorted(cumulative, levels), len(weights) - 1))
