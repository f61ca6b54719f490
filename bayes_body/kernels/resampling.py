"""Resampling schemes, from blackjax. Each draws the ancestors of N particles from their weights; all are unbiased, they differ in variance."""

from collections.abc import Callable
from typing import Literal, cast

import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from bayes_body.shapes import Key

type Scheme = Literal["systematic", "stratified", "multinomial", "residual"]
type Resample = Callable[[Key, Float[Array, " particle"]], Int[Array, " particle"]]


def resampler(scheme: Scheme) -> Resample:
    """From log-weights (normalised or not) to as many ancestors.

    Args:
        scheme: `systematic` and `stratified` spread the draws evenly, `residual` keeps the whole parts of N w, `multinomial` draws independently.
    """
    import blackjax.smc.resampling as schemes

    # blackjax declares no types for its resampling functions: cast once, here.
    function = cast(Callable[[Key, Array, int], Array], getattr(schemes, scheme))

    def resample(key: Key, log_weights: Float[Array, " particle"]) -> Int[Array, " particle"]:
        weights = jnp.exp(log_weights - jnp.max(log_weights))
        return function(key, weights / jnp.sum(weights), log_weights.shape[0])

    return resample
