r"""The door onto blackjax's SMC: one Feynman-Kac step, the temperature that meets an ESS, and the Markov moves that keep a density.

blackjax declares no types for these functions: they are cast once, here.
"""

from collections.abc import Callable, Mapping
from typing import Any, Literal, NamedTuple, cast

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from bayes_body.kernels.resampling import Resample
from bayes_body.shapes import Key, Keys, Scalar

type LogDensity = Callable[[Mapping[str, Array]], Scalar]
type MoveName = Literal["hmc", "random_walk"]

# What a likelihood of zero counts as: a finite number, since 0 * inf is NaN at temperature zero.
LOG_ZERO = -1e30
# A trajectory of one length all the time would return to where it came from on a near Gaussian target.
JITTER = (0.6, 1.4)


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


class Move(NamedTuple):
    """A Markov kernel on coordinates without limits, scaled so that the target is about N(0, 1) in each.

    Attributes:
        start: (position, log_density) -> its state.
        step: (key, state, log_density, scale) -> the state after one move and its acceptance rate. The position is `state.position`.
        acceptance_rate: what its scale is adapted to.
        scale: where the adaptation begins, by the number of coordinates.
        evaluations: of the density, a move.
    """

    start: Callable[[Mapping[str, Array], LogDensity], Any]
    step: Callable[[Key, Any, LogDensity, Scalar], tuple[Any, Scalar]]
    acceptance_rate: float
    scale: Callable[[int], float]
    evaluations: int


def hmc(leapfrog_steps: int) -> Move:
    """Hamiltonian Monte Carlo with unit mass; the step size is jittered by ±40 %."""
    from blackjax.mcmc import hmc

    kernel = hmc.build_kernel()

    def step(key: Key, state: Any, log_density: LogDensity, scale: Scalar) -> tuple[Any, Scalar]:
        jitter_key, move_key = jax.random.split(key)
        size = scale * jax.random.uniform(jitter_key, (), scale.dtype, *JITTER)
        ones = jnp.ones(sum(leaf.size for leaf in state.position.values()), scale.dtype)
        after, info = cast(Any, kernel)(move_key, state, log_density, size, ones, leapfrog_steps)
        return after, info.acceptance_rate

    return Move(cast(Any, hmc.init), step, 0.8, lambda dofs: 0.9 * dofs**-0.25, leapfrog_steps)


def random_walk() -> Move:
    """Random-walk Metropolis with a Gaussian step; begins at Roberts, Gelman & Gilks's (1997) 2.38 / sqrt(d)."""
    from blackjax.mcmc import random_walk

    kernel = random_walk.build_additive_step()

    def step(key: Key, state: Any, log_density: LogDensity, scale: Scalar) -> tuple[Any, Scalar]:
        def random_step(step_key: Key, position: Mapping[str, Array]) -> dict[str, Array]:
            keys = jax.random.split(step_key, len(position))
            return {name: scale * jax.random.normal(k, position[name].shape, scale.dtype) for k, name in zip(keys, sorted(position), strict=True)}

        after, info = cast(Any, kernel)(key, state, log_density, random_step)
        return after, info.acceptance_rate

    return Move(cast(Any, random_walk.init), step, 0.25, lambda dofs: 2.38 * dofs**-0.5, 1)
