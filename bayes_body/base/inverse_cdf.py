"""Draws of an index by weight: the inverse of the weights' cumulative distribution at given levels."""

from typing import Literal

import jax.numpy as jnp
from jaxtyping import Array, Float, Int


def inverse_cdf(
    cumulative: Float[Array, " index"], levels: Float[Array, "*level"], method: Literal["scan", "compare_all"] = "scan"
) -> Int[Array, "*level"]:
    """Return the index in whose share of the weight each level lies.

    One level per draw is enough, where Gumbel noise would need a random number for every index.

    Args:
        cumulative: cumulative sums of the weights, which need not sum to one.
        levels: levels in [0, 1): uniform ones draw independently; evenly spread ones draw systematically.
        method: how `jax.numpy.searchsorted` looks: `scan` bisects in a loop, `compare_all` compares all pairs, which needs no loop.
    """
    # A level that was rounded up to one would lie beyond the last index.
    return jnp.minimum(jnp.searchsorted(cumulative, levels * cumulative[-1], side="right", method=method), cumulative.shape[0] - 1)
