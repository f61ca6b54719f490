"""One chain of Hamiltonian Monte Carlo, by blackjax, without its burn-in.

blackjax declares no types for these functions: they are cast once, here.
"""

from collections.abc import Callable, Mapping
from typing import Any, Literal, NamedTuple, cast

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from bayes_body.kernels.parts import adaptation
from bayes_body.kernels.parts.batching import varying_like
from bayes_body.shapes import Key, Scalar

type Position = Mapping[str, Array]
type Sampler = Literal["hmc", "nuts"]

# A trajectory whose energy error is larger, nats, counts as divergent.
DIVERGENCE = 1000.0
# Doublings of a NUTS trajectory, at most.
DOUBLINGS = 8


class Schedule(NamedTuple):
    """How a chain runs.

    Attributes:
        draws: of the chain.
        burn_in: first states, which are dropped.
        thinning: states a draw.
        leapfrog_steps: of a trajectory; NUTS chooses its own.
        jitter: the share by which the number of steps varies between trajectories, evenly, and equally in all chains.
        sampler: hmc or nuts.
        target_acceptance: to which burn-in tunes the step; 0: the step stays as it is.
        adapts_mass: whether burn-in finds the inverse mass matrix (`kernels/parts/adaptation.py`).
    """

    draws: int
    burn_in: int
    thinning: int
    leapfrog_steps: int
    jitter: float
    sampler: Sampler
    target_acceptance: float
    adapts_mass: bool = False


class Chain(NamedTuple):
    """The draws of a chain, and figures of each transition after burn-in.

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
        axes: names of the mapped axes along which chains adapt together in burn-in.
    """
    from blackjax.mcmc import hmc

    move = _transition(log_density, schedule)
    plan = adaptation.Plan(schedule.burn_in, schedule.target_acceptance, schedule.adapts_mass, axes)

    def one(carry: tuple[Any, adaptation.AdaptationState], turn: tuple[Array, Key]) -> tuple[tuple[Any, adaptation.AdaptationState], Any]:
        (state, adapted), (index, move_key) = carry, turn
        # A matrix that is not carried is factored once, before the loop.
        mass = inverse_mass if adapted.metric is None else adapted.metric.inverse_mass
        state, info = move(move_key, state, jnp.where(index < 0, 0.0, adapted.step), mass, index)
        adapted = adaptation.update(plan, adapted, index, state, info.acceptance_rate)
        steps = jnp.asarray(info.num_integration_steps, jnp.int32)
        return (state, adapted), (dict(state.position), info.acceptance_rate, info.is_divergent, info.energy, steps)

    # The gradient is most of the program. Evaluated before the first move, it would be compiled a second time. NUTS needs it.
    evaluated = schedule.sampler == "nuts"
    first = cast(Any, hmc.init)(dict(position), log_density) if evaluated else _unevaluated(position)
    numbers = jnp.arange(0 if evaluated else -1, schedule.burn_in + schedule.draws * schedule.thinning)
    start = varying_like((first, adaptation.init(plan, step, inverse_mass, position)), position)
    (_, adapted), out = jax.lax.scan(one, start, (numbers, jax.random.split(key, numbers.size)))
    positions, acceptance, divergent, energy, steps = out
    burnt = numbers.size - schedule.draws * schedule.thinning
    draws = {name: value[burnt + schedule.thinning - 1 :: schedule.thinning] for name, value in positions.items()}
    return Chain(draws, acceptance[burnt:], divergent[burnt:], energy[burnt:], adapted.step, jnp.sum(steps) + evaluated)


def chain_figures(chains: Chain) -> dict[str, Array]:
    """For each chain (leading axis): mean acceptance, number of divergences, E-BFMI (Betancourt 2016), step."""
    energy = chains.energy
    moved, varies = jnp.sum(jnp.diff(energy, axis=1) ** 2, axis=1), jnp.sum((energy - energy.mean(axis=1, keepdims=True)) ** 2, axis=1)
    # The potential energy of a chain that stands still is constant; its kinetic energy still varies.
    fraction = jnp.where(varies > 0, moved / jnp.where(varies > 0, varies, 1.0), jnp.nan)
    divergences = jnp.sum(chains.divergent, axis=1, dtype=jnp.int32)
    return {"acceptance": jnp.mean(chains.acceptance, axis=1), "divergences": divergences, "energy_fraction": fraction, "step": chains.step}


def effective_draws(draws: Float[Array, "chain draw dof"]) -> Float[Array, " dof"]:
    """The effective number of draws of all chains together, from each dof's autocorrelation within chains and the spread of the chains' means.

    It is between one and the number of draws. Chains of fewer than four draws count as one draw each.
    """
    from blackjax.diagnostics import effective_sample_size

    chains, length, dofs = draws.shape
    if length < 4:
        return jnp.full((dofs,), float(chains), draws.dtype)
    found = jnp.asarray(cast(Any, effective_sample_size)(draws, chain_axis=0, sample_axis=1)).reshape(dofs)
    return jnp.clip(jnp.where(jnp.isfinite(found), found, 1.0), 1.0, float(chains * length)).astype(draws.dtype)


def leapfrog_steps(schedule: Schedule, index: Int[Array, ""]) -> Int[Array, ""]:
    """Of trajectory number `index`: a sequence that fills the range evenly, as in Hoffman, Radul & Sountsov (2021).

    Chains that run side by side wait for the longest trajectory, so all of them have the same lengths.
    """
    least, most = (max(1, round(schedule.leapfrog_steps * share)) for share in (1 - schedule.jitter, 1 + schedule.jitter))
    # Multiples of the golden ratio, modulo 1, in 32 bits; the first is a half.
    turn = (jnp.asarray(index).astype(jnp.uint32) * jnp.uint32(2654435769) + jnp.uint32(1 << 31)) >> 16
    return least + ((turn * (most - least + 1)) >> 16).astype(jnp.int32)


def _unevaluated(position: Position) -> Any:
    """A state whose density is not known yet: its log is minus infinity, so that the first trajectory, which has step size 0, is accepted."""
    from blackjax.mcmc import hmc

    dtype = jax.tree.leaves(dict(position))[0].dtype
    return hmc.HMCState(dict(position), cast(Any, jnp.full((), -jnp.inf, dtype)), jax.tree.map(jnp.zeros_like, dict(position)))


def _transition(log_density: Callable[[Any], Scalar], schedule: Schedule) -> Callable[[Key, Any, Scalar, Array, Int[Array, ""]], tuple[Any, Any]]:
    """(key, state, step, inverse mass, index) -> the state after transition `index`, and information; that of index -1 has one leapfrog step."""
    from blackjax.mcmc import hmc, nuts

    if schedule.sampler == "nuts":
        kernel = cast(Any, nuts.build_kernel)(divergence_threshold=DIVERGENCE)
        return lambda key, state, size, mass, _: kernel(key, state, log_density, size, mass, DOUBLINGS)
    kernel = cast(Any, hmc.build_kernel)(divergence_threshold=DIVERGENCE)

    def steps(index: Array) -> Array:
        return jnp.where(index < 0, 1, leapfrog_steps(schedule, index))

    return lambda key, state, size, mass, index: kernel(key, state, log_density, size, mass, steps(index))
