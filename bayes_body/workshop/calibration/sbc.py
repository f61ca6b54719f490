r"""Simulation-based calibration (Talts et al. 2018): the truth's rank among draws from its posterior is uniform.

Draw a truth from the model, simulate its data, and filter them. Then take L = bins - 1 independent draws from the particles of the last frame. If the
particles represent the posterior, truth and draws are exchangeable, and the truth's rank among them is uniform on 0 ... L. This holds for every
figure of the state and the data. (The log-likelihood is one: it detects errors that single dofs do not.) Ties, such as two states at the same joint
limit, are broken at random.

The draws must be nearly independent. They come from particles with an effective size of at least `DRAWS_A_BIN` per bin. The effective size is the
smallest of three: of the weights; of the weights after merging equal states; and, after the first frame, after merging all descendants of one
particle of the previous frame.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from bayes_body.base.shapes import Key, Scalar
from bayes_body.density.factor import Particles, State
from bayes_body.density.kernel import NO_ANCESTOR, FilterInfo, Kernel
from bayes_body.workshop.calibration.problem import Case, Problem, draw_case

# Effective particles required per bin of the ranks.
DRAWS_A_BIN = 10
LOG_LIKELIHOOD = "log-likelihood"


class Replication(NamedTuple):
    """The figures of one truth and its posterior.

    Attributes:
        ranks: ranks of the truth among the draws, by quantity; the log-likelihood is last.
        levels: posterior probability below the truth, by quantity without the log-likelihood.
        truth: the quantities of the truth; the log-likelihood is last.
        ess: effective sizes: by weights, by distinct states, by ancestors.
        lost: whether the filter lost a frame.
        refused: as in the case.
        unbounded: as in the case.
    """

    ranks: Int[Array, " quantity"]
    levels: Float[Array, " level"]
    truth: Float[Array, " quantity"]
    ess: Float[Array, "3"]
    lost: Array
    refused: Array
    unbounded: Array


def replicate(problem: Problem, kernel: Kernel, particles: int, frames: int = 2, bins: int = 20) -> Callable[..., Replication]:
    """One replication as a function of its key, and of the problem if a compiled program takes it as an argument.

    Args:
        problem: the model.
        kernel: the kernel to check.
        particles: number of particles of the filter.
        frames: number of filtered frames; the last one is ranked.
        bins: number of possible ranks, one more than draws.
    """

    def replication(key: Key, problem: Problem = problem) -> Replication:
        case_key, filter_key, draw_key, tie_key = jax.random.split(key, 4)
        case = draw_case(case_key, problem, frames)
        previous, particles_after, info, lost = _filtered(filter_key, problem, kernel, case, particles)
        chosen = jax.random.categorical(draw_key, particles_after.log_weights, shape=(bins - 1,))
        truth, drawn, everything = _figures(problem, case, previous, particles_after, info, chosen)
        below_key, within_key = jax.random.split(tie_key)
        ties = jnp.sum(drawn == truth, axis=0)
        ranks = jnp.sum(drawn < truth, axis=0) + jax.random.randint(below_key, ties.shape, 0, ties + 1)
        weights = jax.nn.softmax(particles_after.log_weights)
        same = weights @ (everything == truth[:-1])
        levels = weights @ (everything < truth[:-1]) + same * jax.random.uniform(within_key, same.shape)
        ess = jnp.stack([_ess(weights), _merged(weights, particles_after.states), _by_ancestor(weights, previous, info, frames)])
        return Replication(ranks, levels, truth, ess, lost, case.refused, case.unbounded)

    return replication


def _filtered(key: Key, problem: Problem, kernel: Kernel, case: Case, count: int) -> tuple[Particles, Particles, FilterInfo, Array]:
    """The particles before and after the last frame, its info, and whether any frame was lost."""
    start = problem.start(jax.random.fold_in(key, 1), case.first, count)

    def frame(particles: Particles, key_and_data: tuple[Key, Any]) -> tuple[Particles, tuple[Particles, FilterInfo]]:
        frame_key, data = key_and_data
        next_particles, info = kernel(frame_key, particles, problem.density(data, particles))
        return _like(next_particles, particles), (particles, info)

    frames = jax.tree.leaves(case.path)[0].shape[0]
    last_particles, (parents, info) = jax.lax.scan(frame, start, (jax.random.split(key, frames), case.data))
    last = jax.tree.map(lambda leaf: leaf[-1], (parents, info))
    return last[0], last_particles, last[1], jnp.any(info.lost)


def _like(tree: Any, template: Any) -> Any:
    """The particles with the dtypes of `template`, as a scan's carry needs them."""
    return jax.tree.map(lambda leaf, wanted: jnp.asarray(leaf, wanted.dtype), Particles(dict(tree.states), tree.log_weights), template)


def _figures(
    problem: Problem, case: Case, parent_particles: Particles, particles: Particles, info: FilterInfo, chosen: Int[Array, " draw"]
) -> tuple[Float[Array, " quantity"], Float[Array, "draw quantity"], Float[Array, "particle level"]]:
    """The quantities of the truth and of the draws with the log-likelihood, and of all particles without it."""
    frames = jax.tree.leaves(case.path)[0].shape[0]
    true = jax.tree.map(lambda leaf: leaf[-1], case.path)
    before_true = jax.tree.map(lambda leaf: leaf[-2], case.path) if frames > 1 else case.first
    density = problem.density(jax.tree.map(lambda leaf: leaf[-1], case.data), parent_particles)

    def with_likelihood(state: State, previous: State) -> Float[Array, " quantity"]:
        return jnp.append(problem.quantities.compute(state), density.log_likelihood(state, previous))

    draws = jax.tree.map(lambda leaf: leaf[chosen], particles.states)
    parents = jax.tree.map(lambda leaf: leaf[info.ancestors[chosen]], parent_particles.states)
    # One program for all of them: compiled separately, a draw equal to the truth might differ in the last bit.
    joined = jax.tree.map(lambda leaf, more: jnp.concatenate([leaf[None], more]), (dict(true), dict(before_true)), (dict(draws), dict(parents)))
    quantities = jax.lax.map(lambda pair: with_likelihood(*pair), joined)
    return quantities[0], quantities[1:], jax.vmap(problem.quantities.compute)(particles.states)


def _ess(weights: Float[Array, " particle"]) -> Scalar:
    return jnp.sum(weights) ** 2 / jnp.sum(weights * weights)


def _merged(weights: Float[Array, " particle"], states: State) -> Scalar:
    """The effective size after merging equal states."""
    marks = sum(jnp.tensordot(leaf.reshape(leaf.shape[0], -1), _marks(leaf), 1) for leaf in jax.tree.leaves(dict(states)))
    marks = jnp.asarray(marks)
    order = jnp.argsort(marks)
    new = jnp.concatenate([jnp.zeros(1, jnp.int32), (jnp.diff(marks[order]) != 0).astype(jnp.int32)])
    return _ess(jax.ops.segment_sum(weights[order], jnp.cumsum(new), weights.shape[0]))


def _marks(leaf: Array) -> Array:
    """Sums with fixed random factors: equal states, and up to rounding only these, have equal sums."""
    return jax.random.normal(jax.random.key(0), (leaf[0].size,), leaf.dtype)


def _by_ancestor(weights: Float[Array, " particle"], previous: Particles, info: FilterInfo, frames: int) -> Scalar:
    """The effective size after merging all descendants of a state of the previous frame. In the first frame all come from one state.

    Particles without ancestors have nothing to merge.
    """
    if frames == 1:
        return jnp.asarray(jnp.inf, weights.dtype)
    merged = _merged(weights, jax.tree.map(lambda leaf: leaf[info.ancestors], previous.states))
    return jnp.where(jnp.any(info.ancestors == NO_ANCESTOR), jnp.inf, merged)
