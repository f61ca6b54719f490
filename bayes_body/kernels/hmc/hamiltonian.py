"""One chain of Hamiltonian Monte Carlo, by blackjax. Its burn-in is discarded.

blackjax declares no types for these functions, so they are cast once, here.
"""

from collections.abc import Callable, Mapping
from typing import Any, Literal, NamedTuple, cast

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from bayes_body.base.shapes import Index, Key, Scalar
from bayes_body.density.sharding import varying_like
from bayes_body.kernels.hmc import adaptation

type Position = Mapping[str, Array]
type Sampler = Literal["hmc", "nuts"]
type LogDensity = Callable[[Any], Scalar]

# A trajectory with a larger energy error, in nats, counts as divergent.
DIVERGENCE = 1000.0
# Largest number of doublings of a NUTS trajectory.
DOUBLINGS = 8


class Schedule(NamedTuple):
    """The settings of a chain.

    Attributes:
        draws: number of draws.
        burn_in: number of first states that are discarded.
        thinning: number of states per draw.
        leapfrog_steps: steps of a trajectory; NUTS chooses its own number.
        jitter: fraction by which the number of steps varies between trajectories; it varies evenly, and in the same way in all chains.
        sampler: hmc or nuts.
        target_acceptance: acceptance rate to which burn-in tunes the step; with 0 the step is not tuned.
        adapts_mass: whether burn-in finds the inverse mass matrix (`kernels/hmc/adaptation.py`).
    """

    draws: int
    burn_in: int
    thinning: int
    leapfrog_steps: int
    jitter: float
    sampler: Sampler
    target_acceptance: float
    adapts_mass: bool = False


class WithAncestor(NamedTuple):
    """A target whose chain has an ancestor too, which a Gibbs step redraws before each trajectory.

    Attributes:
        start: the first ancestor.
        conditional: ancestor -> the log-density of a position given that ancestor.
        redraw: (key, ancestor, position) -> another ancestor; leaves p(ancestor | position) invariant.
        evaluations: number of evaluations of the density per redraw.
    """

    start: Index
    conditional: Callable[[Index], LogDensity]
    redraw: Callable[[Key, Index, Position], Index]
    evaluations: int


class Chain(NamedTuple):
    """The draws of a chain, and figures for each transition after burn-in.

    Attributes:
        positions: the draws, along a leading axis.
        acceptance: acceptance probabilities.
        divergent: whether each trajectory diverged.
        energy: total energy, nats, up to a constant.
        step: the factor of the step size after burn-in.
        gradients: number of evaluations of the density with its gradient, including burn-in.
        ancestors: the ancestor of each draw, if the target has one.
    """

    positions: dict[str, Float[Array, "draw *shape"]]
    acceptance: Float[Array, " transition"]
    divergent: Bool[Array, " transition"]
    energy: Float[Array, " transition"]
    step: Scalar
    gradients: Int[Array, ""]
    ancestors: Int[Array, " draw"] | None = None


def run_chain(
    key: Key,
    position: Position,
    log_density: LogDensity | WithAncestor,
    step: Scalar,
    inverse_mass: Float[Array, " dof *dof"],
    schedule: Schedule,
    axes: tuple[str, ...] = (),
) -> Chain:
    """Run one chain.

    Args:
        key: random key.
        position: the start.
        log_density: the target.
        step: size of a leapfrog step in units of the mass matrix.
        inverse_mass: diagonal or dense, over the position's variables in alphabetical order.
        schedule: the settings of the chain.
        axes: names of the mapped axes along which chains adapt together in burn-in.
    """
    from blackjax.mcmc import hmc

    move = _transition(schedule)
    plan = adaptation.Plan(schedule.burn_in, schedule.target_acceptance, schedule.adapts_mass, axes)
    extended = log_density if isinstance(log_density, WithAncestor) else None

    def advance(
        carry: tuple[Any, adaptation.AdaptationState, Any], turn: tuple[Array, Key]
    ) -> tuple[tuple[Any, adaptation.AdaptationState, Any], Any]:
        (state, adapted, ancestor), (index, key) = carry, turn
        target: Any = log_density
        if extended is not None:
            key, redraw_key = jax.random.split(key)
            ancestor = extended.redraw(redraw_key, ancestor, state.position)
            target = extended.conditional(ancestor)
            state = cast(Any, hmc.init)(state.position, target)
        # A matrix that does not change is factored once, before the loop.
        mass = inverse_mass if adapted.metric is None else adapted.metric.inverse_mass
        state, info = move(key, state, target, jnp.where(index < 0, 0.0, adapted.step), mass, index)
        adapted = adaptation.update(plan, adapted, index, state, info.acceptance_rate)
        steps = jnp.asarray(info.num_integration_steps, jnp.int32)
        return (state, adapted, ancestor), (dict(state.position), info.acceptance_rate, info.is_divergent, info.energy, steps, ancestor)

    # The gradient is most of the program. Evaluating it before the first move would compile it a second time. Only NUTS needs that. After a redraw
    # of the ancestor it is evaluated anyway.
    evaluated = schedule.sampler == "nuts" and extended is None
    first = cast(Any, hmc.init)(dict(position), log_density) if evaluated else _unevaluated(position)
    numbers = jnp.arange(0 if evaluated or extended is not None else -1, schedule.burn_in + schedule.draws * schedule.thinning)
    ancestor = None if extended is None else extended.start
    start = varying_like((first, adaptation.init(plan, step, inverse_mass, position), ancestor), position)
    (_, adapted, _), out = jax.lax.scan(advance, start, (numbers, jax.random.split(key, numbers.size)))
    positions, acceptance, divergent, energy, steps, ancestors = out
    burnt, thinning = numbers.size - schedule.draws * schedule.thinning, slice(schedule.thinning - 1, None, schedule.thinning)
    draws, ancestors = jax.tree.map(lambda leaf: leaf[burnt:][thinning], (positions, ancestors))
    redrawn = 0 if extended is None else numbers.size * (extended.evaluations + 1)
    return Chain(draws, acceptance[burnt:], divergent[burnt:], energy[burnt:], adapted.step, jnp.sum(steps) + evaluated + redrawn, ancestors)


def chain_figures(chains: Chain) -> dict[str, Array]:
    """Return for each chain (leading axis): mean acceptance, number of divergences, E-BFMI (Betancourt 2016), step."""
    energy = chains.energy
    moved, varies = jnp.sum(jnp.diff(energy, axis=1) ** 2, axis=1), jnp.sum((energy - energy.mean(axis=1, keepdims=True)) ** 2, axis=1)
    # If a chain does not move, its potential energy is constant, but its kinetic energy still varies.
    fraction = jnp.where(varies > 0, moved / jnp.where(varies > 0, varies, 1.0), jnp.nan)
    divergences = jnp.sum(chains.divergent, axis=1, dtype=jnp.int32)
    return {"acceptance": jnp.mean(chains.acceptance, axis=1), "divergences": divergences, "energy_fraction": fraction, "step": chains.step}


def effective_draws(draws: Float[Array, "chain draw dof"]) -> Float[Array, " dof"]:
    """Return the effective number of draws of all chains together, from each dof's autocorrelation and the spread of the chains' means.

    The result is between one and the number of draws. A chain with fewer than four draws counts as one draw.
    """
    from blackjax.diagnostics import effective_sample_size

    chains, length, dofs = draws.shape
    if length < 4:
        return jnp.full((dofs,), float(chains), draws.dtype)
    effective = jnp.asarray(cast(Any, effective_sample_size)(draws, chain_axis=0, sample_axis=1)).reshape(dofs)
    return jnp.clip(jnp.where(jnp.isfinite(effective), effective, 1.0), 1.0, float(chains * length)).astype(draws.dtype)


def leapfrog_steps(schedule: Schedule, index: Int[Array, ""]) -> Int[Array, ""]:
    """Return the number of steps of trajectory number `index`, from a sequence that fills the range evenly (Hoffman, Radul & Sountsov 2021).

    Chains that run in parallel wait for the longest trajectory, so all chains use the same lengths.
    """
    least, most = (max(1, round(schedule.leapfrog_steps * share)) for share in (1 - schedule.jitter, 1 + schedule.jitter))
    # Multiples of the golden ratio, modulo 1, in 32 bits; the first value is a half.
    turn = (jnp.asarray(index).astype(jnp.uint32) * jnp.uint32(2654435769) + jnp.uint32(1 << 31)) >> 16
    return least + ((turn * (most - least + 1)) >> 16).astype(jnp.int32)


def _unevaluated(position: Position) -> Any:
    """Return a state with an unknown density. Its log-density is minus infinity, so that the first trajectory, with step size 0, is accepted."""
    from blackjax.mcmc import hmc

    dtype = jax.tree.leaves(dict(position))[0].dtype
    return hmc.HMCState(dict(position), cast(Any, jnp.full((), -jnp.inf, dtype)), jax.tree.map(jnp.zeros_like, dict(position)))


def _transition(schedule: Schedule) -> Callable[[Key, Any, LogDensity, Scalar, Array, Int[Array, ""]], tuple[Any, Any]]:
    """Return (key, state, target, step, inverse mass, index) -> the state after transition `index`, and information. Index -1 has one step."""
    from blackjax.mcmc import hmc, nuts

    if schedule.sampler == "nuts":
        kernel = cast(Any, nuts.build_kernel)(divergence_threshold=DIVERGENCE)
        return lambda key, state, target, size, mass, _: kernel(key, state, target, size, mass, DOUBLINGS)
    kernel = cast(Any, hmc.build_kernel)(divergence_threshold=DIVERGENCE)

    def steps(index: Array) -> Array:
        return jnp.where(index < 0, 1, leapfrog_steps(schedule, index))

    return lambda key, state, target, size, mass, index: kernel(key, state, target, size, mass, steps(index))
