"""Resampling schemes, from blackjax. Each draws ancestors of particles by weight. All are unbiased; they differ in variance."""

from collections.abc import Callable
from typing import Literal, Protocol, cast

import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from bayes_body.base.shapes import Key

type Scheme = Literal["systematic", "stratified", "multinomial", "residual"]


class Resample(Protocol):
    """A function from log-weights (normalised or not) to ancestors: as many as there are weights, or `count`."""

    def __call__(self, key: Key, log_weights: Float[Array, " particle"], count: int | None = None) -> Int[Array, " drawn"]: ...  # noqa: D102


def resampler(scheme: Scheme) -> Resample:
    """Return a scheme by name.

    Args:
        scheme: `systematic` and `stratified` spread the draws evenly, `residual` keeps the integer parts of N w, `multinomial` draws independently.
    """
    import blackjax.smc.resampling as schemes

    # blackjax declares no types for its resampling functions, so they are cast once, here.
    function = cast(Callable[[Key, Array, int], Array], getattr(schemes, scheme))

    def resample(key: Key, log_weights: Float[Array, " particle"], count: int | None = None) -> Int[Array, " drawn"]:
        weights = jnp.exp(log_weights - jnp.max(log_weights))
        return function(key, weights / jnp.sum(weights), log_weights.shape[0] if count is None else count)

    return resample
