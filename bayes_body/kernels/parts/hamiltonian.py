"""The door onto blackjax's Hamiltonian Monte Carlo: one chain, its burn-in left out.

blackjax declares no types for these functions: they are cast once, here.
"""

from collections.abc import Callable, Mapping
from typing import Any, Literal, NamedTuple, cast

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from bayes_body.kernels.parts import adaptation
from bayes_body.shapes import Key, Scalar

type Position = Mapping[str, Array]
type Sampler = Literal["hmc", "nuts"]

# An error of the energy, nats, from which on a trajectory counts as divergent.
DIVERGENCE = 1000.0
# Doublings of a NUTS trajectory, at most.
DOUBLINGS = 8


class Schedule(NamedTuple):
    """How a chain runs: draws kept, states left out first, states a draw, and its trajectories.

    Attributes:
        kept: draws.
        burn_in: first states that are left out.
        thinning: states for one draw.
        leapfrog_steps: of a trajectory; NUTS chooses its own.
        jitter: the share by which their number varies from trajectory to trajectory, evenly, alike in all chains.
        sampler: hmc or nuts.
        target_acceptance: to which the step is tuned in burn-in; 0 leaves it.
        adapts_mass: whether burn-in finds the inverse mass matrix (`kernels/parts/adaptation.py`).
    """

    kept: int
    burn_in: int
    thinning: int
    leapfrog_steps: int
    jitter: float
    sampler: Sampler
    target_acceptance: float
    adapts_mass: bool = False


class Chain(NamedTuple):
    """What a chain leaves: its draws, and of each transition behind burn-in how it went.

    Attributes:
        positions: draws, with a leading axis.
        acceptance: probabilities of acceptance.
        divergent: whether a trajectory diverged.
        energy: total energy, nats, up to a constant.
        step: the factor of the step size after burn-in.
        gradients: evaluations of the density with its gradient, burn-in included.
    """

    positions: dict[str, Float[Array, "draw *shape"]]
    acceptance: Float[Array, " transition"]
    divergent: Bool[Array, " transition"]
    energy: Float[Array, " transition"]
    step: Scalar
    gradients: Int[Array, ""]


def run_chain(
    key: Key,
    position: Position,
    log_density: Callable[[Any], Scalar],
    step: Scalar,
    inverse_mass: Float[Array, " dof *dof"],
    schedule: Schedule,
    axes: tuple[str, ...] = (),
) -> Chain:
    """One chain.

    Args:
        key: of the chain.
        position: where it starts.
        log_density: the target.
        step: size of a leapfrog step in units of the mass matrix.
        inverse_mass: diagonal or dense, over the position's variables in alphabetical order.
        schedule: how it runs.
        axes: names of the mapped axes along which chains learn together in burn-in.
    """
    from blackjax.mcmc import hmc

    move = _transition(log_density, schedule)
    plan = adaptation.Plan(schedule.burn_in, schedule.target_acceptance, schedule.adapts_mass, axes)

    def one(carry: tuple[Any, adaptation.AdaptationState], own: tuple[Array, Key]) -> tuple[tuple[Any, adaptation.AdaptationState], Any]:
        (state, found), (index, own_key) = carry, own
        # What is not carried is hoisted out of the loop.
        mass = inverse_mass if found.metric is None else found.metric.inverse_mass
        state, info = move(own_key, state, jnp.where(index < 0, 0.0, found.step), mass, index)
        found = adaptation.update(plan, found, index, state, info.acceptance_rate)
        steps = jnp.asarray(info.num_integration_steps, jnp.int32)
        return (state, found), (dict(state.position), info.acceptance_rate, info.is_divergent, info.energy, steps)

    # The gradient is most of a program: with one to begin from besides that of the moves it would be compiled twice. NUTS needs it.
    evaluated = schedule.sampler == "nuts"
    first = cast(Any, hmc.init)(dict(position), log_density) if evaluated else _unevaluated(position)
    numbers = jnp.arange(0 if evaluated else -1, schedule.burn_in + schedule.kept * schedule.thinning)
    # What is carried must differ from device to device where the position does.
    nothing = _nothing(position)
    carried = jax.tree.map(lambda leaf: leaf + nothing, (first, adaptation.init(plan, step, inverse_mass + nothing, position)))
    (_, found), out = jax.lax.scan(one, carried, (numbers, jax.random.split(key, numbers.size)))
    positions, acceptance, divergent, energy, steps = out
    behind = numbers.size - schedule.kept * schedule.thinning
    draws = {name: value[behind + schedule.thinning - 1 :: schedule.thinning] for name, value in positions.items()}
    return Chain(draws, acceptance[behind:], divergent[behind:], energy[behind:], found.step, jnp.sum(steps) + evaluated)


def chain_figures(chains: Chain) -> dict[str, Array]:
    """Of chains with a leading axis, how each went: acceptance, number of divergences, E-BFMI (Betancourt 2016), step."""
    energy = chains.energy
    moved, varies = jnp.sum(jnp.diff(energy, axis=1) ** 2, axis=1), jnp.sum((energy - energy.mean(axis=1, keepdims=True)) ** 2, axis=1)
    # A chain that stands still keeps its position's energy, and its momentum's varies freely.
    fraction = jnp.where(varies > 0, moved / jnp.where(varies > 0, varies, 1.0), jnp.nan)
    divergences = jnp.sum(chains.divergent, axis=1, dtype=jnp.int32)
    return {"acceptance": jnp.mean(chains.acceptance, axis=1), "divergences": divergences, "energy_fraction": fraction, "step": chains.step}


def effective_draws(draws: Float[Array, "chain draw dof"]) -> Float[Array, " dof"]:
    """How many independent draws the draws of all chains are worth, by each dof's autocorrelation within chains and the spread of their means.

    At most as many as there are, at least one; of fewer than four draws a chain nothing is known, and each chain counts once.
    """
    from blackjax.diagnostics import effective_sample_size

    chains, kept, dofs = draws.shape
    if kept < 4:
        return jnp.full((dofs,), float(chains), draws.dtype)
    found = jnp.asarray(cast(Any, effective_sample_size)(draws, chain_axis=0, sample_axis=1)).reshape(dofs)
    return jnp.clip(jnp.where(jnp.isfinite(found), found, 1.0), 1.0, float(chains * kept)).astype(draws.dtype)


def leapfrog_steps(schedule: Schedule, index: Int[Array, ""]) -> Int[Array, ""]:
    """Of the trajectory of that number: a sequence that fills the range evenly, as in Hoffman, Radul & Sountsov (2021).

    Chains side by side wait for the longest trajectory: the lengths are the same in all of them.
    """
    least, most = (max(1, round(schedule.leapfrog_steps * share)) for share in (1 - schedule.jitter, 1 + schedule.jitter))
    # Multiples of the golden ratio, modulo 1, in 32 bits; the first is a half.
    turn = (jnp.asarray(index).astype(jnp.uint32) * jnp.uint32(2654435769) + jnp.uint32(1 << 31)) >> 16
    return least + ((turn * (most - least + 1)) >> 16).astype(jnp.int32)


def _unevaluated(position: Position) -> Any:
    """A state whose density is still to be found: any trajectory from minus infinity is accepted, and the first one goes nowhere."""
    from blackjax.mcmc import hmc

    dtype = jax.tree.leaves(dict(position))[0].dtype
    return hmc.HMCState(dict(position), cast(Any, jnp.full((), -jnp.inf, dtype)), jax.tree.map(jnp.zeros_like, dict(position)))


def _nothing(position: Position) -> Scalar:
    """Zero, whatever the position."""
    values = jax.tree.leaves(dict(position))[0]
    return 0 * jnp.isnan(values.ravel()[0]).astype(values.dtype)


def _transition(log_density: Callable[[Any], Scalar], schedule: Schedule) -> Callable[[Key, Any, Scalar, Array, Int[Array, ""]], tuple[Any, Any]]:
    """(key, state, step, inverse mass, number of the transition) -> the state after it, and information; that of number -1 has one step."""
    from blackjax.mcmc import hmc, nuts

    if schedule.sampler == "nuts":
        kernel = cast(Any, nuts.build_kernel)(divergence_threshold=DIVERGENCE)
        return lambda key, state, size, mass, _: kernel(key, state, log_density, size, mass, DOUBLINGS)
    kernel = cast(Any, hmc.build_kernel)(divergence_threshold=DIVERGENCE)

    def steps(index: Array) -> Array:
        return jnp.where(index < 0, 1, leapfrog_steps(schedule, index))

    return lambda key, state, size, mass, index: kernel(key, state, log_density, size, mass, steps(index))
