"""The starts of a frame's chains, and their targets on the extended view.

Starts are states drawn from the prediction and selected by the likelihood. A chain may start anywhere, but it often does not leave the mode in which
it started. So a mode without a start is not found.

Chains run on the extended view if a likelihood compares a state with its own past, as image motion does. The marginal view would evaluate the images
once for each ancestor. On the extended view a chain has one ancestor, which a Gibbs step redraws before each trajectory.
"""

from collections.abc import Callable
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Int

from bayes_body.base.shapes import Flag, Index, Key, Keys, Scalar
from bayes_body.density.density import Density, Unconstrained
from bayes_body.density.extended import extended
from bayes_body.density.factor import Particles, State
from bayes_body.density.kernel import FilterInfo, Kernel
from bayes_body.kernels.hmc.hamiltonian import WithAncestor
from bayes_body.kernels.smc import annealed_filter, tempered_smc
from bayes_body.kernels.weights import Resample, predict

type StartsBy = Literal["importance", "annealing", "tempering"]


class Start(NamedTuple):
    """The start of a chain: unconstrained coordinates, and the ancestor from which the state was predicted."""

    position: dict[str, Array]
    ancestor: Int[Array, ""]


class Initialisation(NamedTuple):
    """The starts of all chains, and figures about the search for them.

    Attributes:
        starts: one per chain, along a leading axis.
        log_evidence: an estimate from draws of the prediction, nats.
        lost: whether no draw explained the image.
        evaluations: number of evaluations of the likelihood.
    """

    starts: Start
    log_evidence: Scalar
    lost: Flag
    evaluations: Any


def by_importance(key: Key, target: Unconstrained, count: int, chains: int, resample: Resample) -> Initialisation:
    """Choose starts by sampling importance resampling of draws from the prediction mixture (Poon & Fleet 2002, 4).

    If the likelihood is much narrower than the prediction, only a few of the draws are chosen, each several times.

    Args:
        key: random key.
        target: the marginal view of the frame's density, given the particles of the previous frame.
        count: number of draws from the prediction mixture.
        chains: number of starts.
        resample: a resampling scheme.
    """
    ancestor_key, draw_key, resample_key = jax.random.split(key, 3)
    ancestors = resample(ancestor_key, target.density.previous.log_weights, count)
    drawn = predict(draw_key, ancestors, target.density)
    weights = drawn.normalised()
    chosen = resample(resample_key, weights.log_weights, chains)
    position = jax.vmap(target.unconstrain)(jax.tree.map(lambda leaf: leaf[chosen], dict(drawn.states)))
    return Initialisation(Start(position, ancestors[chosen]), drawn.log_evidence(), weights.lost, count)


def by_annealing(key: Key, target: Unconstrained, count: int, chains: int, resample: Resample) -> Initialisation:
    """Choose starts by weight among particles of the annealed filter (Deutscher & Reid 2005), which starts from the same mixture.

    Its layers weight by powers of the likelihood at which half of the particles survive. So a mode that is worse by some tens of nats keeps a start,
    and one or two images later it may turn out to be the right one. The annealed filter does not estimate the evidence. The estimate uses another
    `count` draws from the prediction.

    Args:
        key: random key.
        target: as for `by_importance`.
        count: number of particles.
        chains: number of starts.
        resample: a resampling scheme.
    """
    keys = jax.random.split(key, 4)
    by_weight = by_importance(keys[0], target, count, chains, resample)
    starts, info = _among_particles(keys[1:], annealed_filter.build_kernel(), target, count, chains, resample)
    return by_weight._replace(starts=starts, lost=by_weight.lost | info.lost, evaluations=by_weight.evaluations + info.evaluations)


def by_tempering(key: Key, target: Unconstrained, count: int, chains: int, resample: Resample) -> Initialisation:
    """Choose starts among particles of tempered SMC, so that chains begin in modes about as often as the posterior is there.

    With a prior with potentials there is no other way: of independent draws, one would have all the weight.

    Args:
        key: random key.
        target: as for `by_importance`.
        count: number of particles.
        chains: number of starts.
        resample: a resampling scheme.
    """
    starts, info = _among_particles(jax.random.split(key, 3), tempered_smc.build_kernel(), target, count, chains, resample)
    return Initialisation(starts, info.log_evidence, info.lost, info.evaluations)


def _among_particles(keys: Keys, kernel: Kernel, target: Unconstrained, count: int, chains: int, resample: Resample) -> tuple[Start, FilterInfo]:
    """Run a kernel on `count` particles of the previous frame, and choose starts by weight among its particles."""
    parent_key, kernel_key, choose_key = keys
    previous = target.density.previous
    parents = resample(parent_key, previous.log_weights, count)
    equal = jnp.full((count,), -jnp.log(count), previous.log_weights.dtype)
    parent_particles = Particles(jax.tree.map(lambda leaf: leaf[parents], dict(previous.states)), equal)
    filtered, info = kernel(kernel_key, parent_particles, target.density)
    chosen = resample(choose_key, filtered.log_weights, chains)
    position = jax.vmap(target.unconstrain)(jax.tree.map(lambda leaf: leaf[chosen], dict(filtered.states)))
    return Start(position, parents[info.ancestors[chosen]]), info


def compares_frames(density: Density) -> bool:
    """Return whether a likelihood depends on the previous frame."""
    return any(factor.reads_previous and factor.side == "likelihood" for factor in density.factors)


def with_ancestor(start: Start, density: Density, candidates: int) -> WithAncestor:
    """Return the extended view as a target, beginning with the ancestor that a chain's start was predicted from.

    Args:
        start: the start of the chain.
        density: the density of the frame.
        candidates: the number of ancestors among which a chain redraws its own, including the current one.
    """
    view = extended(density)

    def redraw(key: Key, ancestor: Index, position: State) -> Index:
        return view.choose_ancestor(key, ancestor, position, 1.0, candidates)

    def conditional(ancestor: Index) -> Callable[[State], Scalar]:
        return lambda position: view.log_density(ancestor, position)[0]

    return WithAncestor(start.ancestor, conditional, redraw, candidates)


def whole_states(draws: State, ancestors: Int[Array, " draw"], target: Unconstrained) -> State:
    """Return the whole states of draws whose ancestors are known, along a leading axis."""
    transition = target.density.transition

    def whole_state(position: State, ancestor: Index) -> State:
        return transition.carry(target.density.ancestor(ancestor), target.constrain(position))

    return jax.vmap(whole_state)(draws, ancestors)
