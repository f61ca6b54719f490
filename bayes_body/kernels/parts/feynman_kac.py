r"""The door onto blackjax's SMC: one Feynman-Kac step, and the temperature that meets an ESS.

blackjax declares no types for these functions: they are cast once, here.
"""

from collections.abc import Callable
from typing import Any, NamedTuple, cast

import jax.numpy as jnp
from jaxtyping import Array, Float

from bayes_body.kernels.parts.resampling import Resample
from bayes_body.shapes import Key, Keys, Scalar

# What a likelihood of zero counts as: a finite number, since 0 * inf is NaN at temperature zero.
LOG_ZERO = -1e30


class Reweighted(NamedTuple):
    """Particles after a step, with normalised log-weights; `log_increment` is the log of the mean of the weights before that."""

    particles: Any
    log_weights: Float[Array, " particle"]
    log_increment: Scalar
    info: Any


def feynman_kac_step(
    key: Key,
    particles: Any,
    log_weights: Float[Array, " particle"],
    move: Callable[[Keys, Any], tuple[Any, Any]],
    log_potential: Callable[[Any], Float[Array, " particle"]],
    resample: Resample,
    resampled: int,
) -> Reweighted:
    """Resample, move, reweight (`blackjax.smc.base.step`).

    Args:
        key: of the step.
        particles: pytree with a leading particle axis.
        log_weights: of the particles, normalised or not.
        move: (keys, resampled particles) -> as many particles as there were, and information.
        log_potential: the new log-weights of all moved particles.
        resample: a scheme.
        resampled: how many are resampled; fewer than the particles where `move` keeps several states of each.
    """
    from blackjax.smc import base

    weights = jnp.exp(log_weights - jnp.max(log_weights))
    state = base.SMCState(particles, weights / jnp.sum(weights), {})

    def chosen(resampling_key: Key, weights: Array, count: int | Array) -> Array:
        return resample(resampling_key, jnp.log(weights), int(count))

    def update(keys: Keys, parents: Any, _: Any) -> tuple[Any, Any]:
        return move(keys, parents)

    # What the step is given it calls with these arguments, whatever it declares.
    after, info = cast(Any, base.step)(key, state, update, log_potential, chosen, resampled)
    return Reweighted(after.particles, jnp.log(after.weights), info.log_likelihood_increment, info.update_info)


def next_increment(log_likelihoods: Float[Array, " particle"], share: float, most: Scalar) -> Scalar:
    """The largest step in temperature, up to `most`, after which equal weights still have an ESS of `share` of the particles."""
    from blackjax.smc import ess, solver

    relative = log_likelihoods - jnp.max(log_likelihoods)
    increment = ess.ess_solver(lambda log_likelihood: log_likelihood, relative, share, most, _bisect(solver.dichotomy))
    return jnp.clip(jnp.asarray(increment, relative.dtype), 0.0, most)


def _bisect(dichotomy: Callable[..., Any]) -> Callable[..., Array]:
    # Down to float32's resolution: a sharp likelihood's first step may be 1e-7.
    return lambda function, low, high: dichotomy(function, low, high, eps=1e-3, max_iter=60)
