r"""The stages of tempered SMC: their powers, their state, the Feynman-Kac step through blackjax, and the correction of moments at the end.

The powers are those of the prior's potentials, $\alpha$, and of the likelihood, $\beta$. First $\alpha$ goes from 0 to 1, then $\beta$. The ladder
records the powers of all stages.

blackjax declares no types for these functions, so they are cast once, here.
"""

from collections.abc import Callable
from typing import Any, NamedTuple, cast

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from bayes_body.base.shapes import Flag, Index, Key, Keys, Scalar
from bayes_body.density.gaussian_view import joined, split
from bayes_body.density.tempering import LogTerms
from bayes_body.kernels.smc.moment_correction import corrected_moments, with_moments
from bayes_body.kernels.smc.moves import ExtendedParticle
from bayes_body.kernels.weights import LogWeights, Resample, normalise


class Ladder(NamedTuple):
    """The powers of a run, and the log step size and whitening of the moves at each. Entries of unused stages are NaN.

    The powers are those of the likelihood (`inverse_temperatures`) and of the prior's potentials, which reach 1 first.
    """

    inverse_temperatures: Float[Array, " stage"]
    potential_powers: Float[Array, " stage"]
    log_step_sizes: Float[Array, " stage"]
    whitening: dict[str, Float[Array, "stage dof dof"]]

    def with_powers(self, stage: Index, powers: LogTerms) -> "Ladder":
        """Return the ladder with the powers that a stage reached added to it."""
        return self._replace(
            inverse_temperatures=self.inverse_temperatures.at[stage].set(powers.likelihood),
            potential_powers=self.potential_powers.at[stage].set(powers.potential),
        )

    def with_moves(self, stage: Index, log_step_size: Scalar, whitening: dict[str, Float[Array, "dof dof"]]) -> "Ladder":
        """Return the ladder with the settings of a stage's moves added to it."""
        roots = {name: self.whitening[name].at[stage].set(root) for name, root in whitening.items()}
        return self._replace(log_step_sizes=self.log_step_sizes.at[stage].set(log_step_size), whitening=roots)

    def increment(self, powers: LogTerms, stage: Index) -> LogTerms:
        """Return the step of both powers that this ladder prescribes for a stage."""
        return LogTerms(self.inverse_temperatures[stage] - powers.likelihood, self.potential_powers[stage] - powers.potential)


def increment(terms: LogTerms, powers: LogTerms, target_ess: float, is_last: Flag) -> LogTerms:
    """Return the step of both powers. First the potentials' power rises to 1, then the likelihood's. The last stage takes both to 1.

    Args:
        terms: the particles' terms, with a leading particle axis.
        powers: the powers reached.
        target_ess: the fraction of the particles below which the effective sample size must not fall.
        is_last: whether no stage is left after this one.
    """
    on_potentials = powers.potential < 1
    heated = jnp.where(on_potentials, terms.potential, terms.likelihood)
    remaining = LogTerms(1 - powers.likelihood, 1 - powers.potential)
    step = next_increment(heated, target_ess, jnp.where(on_potentials, remaining.potential, remaining.likelihood))
    likelihood, potential = jnp.where(on_potentials, 0.0, step), jnp.where(on_potentials, step, 0.0)
    return LogTerms(jnp.where(is_last, remaining.likelihood, likelihood), jnp.where(is_last, remaining.potential, potential))


def potentials_share(step: LogTerms, terms: LogTerms) -> Scalar:
    """Return the share of a stage's evidence that belongs to the potentials: all of it while their power rises, none afterwards.

    If too few stages are left, the last one takes both powers to 1 at once, and only the likelihood's share is evidence.
    """
    share = normalise(step.potential * terms.potential).log_sum - jnp.log(terms.potential.shape[0])
    return jnp.where(step.potential > 0, share, 0.0)


def is_at_top(powers: LogTerms) -> Flag:
    """Return whether both powers are 1."""
    return (powers.likelihood >= 1) & (powers.potential >= 1)


def next_increment(log_likelihoods: LogWeights, target_ess: float, most: Scalar) -> Scalar:
    """Return the largest step of a term's power, up to `most`, after which equal weights have an ESS of at least the fraction `target_ess`."""
    from blackjax.smc import ess, solver

    relative = log_likelihoods - jnp.max(log_likelihoods)
    increment = ess.ess_solver(lambda log_likelihood: log_likelihood, relative, target_ess, most, _bisect(solver.dichotomy))
    return jnp.clip(jnp.asarray(increment, relative.dtype), 0.0, most)


def _bisect(dichotomy: Callable[..., Any]) -> Callable[..., Array]:
    # Bisect to the resolution of float32, since the first step of a sharp likelihood may be 1e-7.
    return lambda function, low, high: dichotomy(function, low, high, eps=1e-3, max_iter=60)


# The log of a likelihood of zero, as stored for particles. It is finite, so that differences between particles are not NaN.
LOG_ZERO = -1e30
# The moments are corrected if at most this share of the last proposals was behind a wall. Stein's identity does not hold at a wall.
MOST_IMPOSSIBLE = 0.01


def finite_log(log_likelihood: Array) -> Array:
    """Return the log-likelihood, but at least `LOG_ZERO`. NaN counts as a likelihood of zero."""
    return jnp.maximum(jnp.where(jnp.isnan(log_likelihood), LOG_ZERO, log_likelihood), LOG_ZERO)


class Finals(NamedTuple):
    """Positions and slopes after the stages at the posterior, as vectors."""

    positions: Float[Array, "stage particle dof"]
    slopes: Float[Array, "stage particle dof"]

    def with_stage(self, number: Index, at_top: Flag, particles: ExtendedParticle) -> "Finals":
        """Return the positions and slopes with those of final stage `number` added, if `at_top`; unchanged if none are kept."""
        if not self.positions.shape[0]:
            return self
        final = Finals(jax.vmap(joined)(particles.position), jax.vmap(joined)(particles.slope))
        return jax.tree.map(lambda stored, new: jnp.where(at_top, stored.at[number].set(new), stored), self, final)


class TemperedState(NamedTuple):
    """The state passed from stage to stage. Rates have one value per stage, like the ladder.

    `impossible` is the share of the last stage's proposals that had no density, such as those behind a constraint. `finals` are the positions and
    slopes after each stage at the posterior itself, if they are needed.
    """

    particles: ExtendedParticle
    log_weights: LogWeights
    powers: LogTerms
    stage: Int[Array, ""]
    stages_at_top: Int[Array, ""]
    log_evidence: Scalar
    log_step_size: Scalar
    ladder: Ladder
    survival_rates: Float[Array, " stage"]
    acceptance_rates: Float[Array, " stage"]
    impossible: Scalar
    finals: Finals


def init_state(
    particles: ExtendedParticle,
    log_weights: LogWeights,
    stages: int,
    step_size: Callable[[int], float],
    potential_power: float,
    finals: int = 0,
) -> TemperedState:
    """Return the state at inverse temperature zero, before any stage.

    Args:
        particles: particles of the prediction.
        log_weights: their log-weights, from the constraints.
        stages: the largest possible number of stages.
        step_size: the step size of the first moves, as a function of the number of coordinates.
        potential_power: the power of the prior's potentials: 0 if there are any, else 1.
        finals: the number of stages at the posterior itself whose positions and slopes are kept.
    """
    dtype = log_weights.dtype
    nan = jnp.full((stages,), jnp.nan, dtype)
    roots = {name: jnp.full((stages, x.shape[1], x.shape[1]), jnp.nan, dtype) for name, x in particles.position.items()}
    log_step_size = jnp.log(jnp.asarray(step_size(sum(x.shape[1] for x in particles.position.values())), dtype))
    zero, no_stage = jnp.zeros((), dtype), jnp.zeros((), int)
    powers, ladder = LogTerms(zero, jnp.full((), potential_power, dtype)), Ladder(nan, nan, nan, roots)
    dofs = sum(x.shape[1] for x in particles.position.values())
    empty = jnp.zeros((finals, log_weights.shape[0], dofs), dtype)
    return TemperedState(particles, log_weights, powers, no_stage, no_stage, zero, log_step_size, ladder, nan, nan, zero, Finals(empty, empty))


def corrected_positions(last: TemperedState) -> dict[str, Array]:
    """Return the positions of the particles, with moments corrected by the slopes of the final stages if these are kept and no wall is close."""
    position, stages = last.particles.position, last.finals.positions.shape[0]
    if not stages:
        return position
    positions, slopes = (values.reshape(-1, values.shape[-1]) for values in last.finals)
    wanted = corrected_moments(positions, jnp.tile(last.log_weights, stages), slopes)
    moved = with_moments(jax.vmap(joined)(position), last.log_weights, wanted)
    form = jax.tree.map(lambda leaf: leaf[0], position)
    split_up = jax.vmap(lambda vector: split(vector, form))(moved)
    return jax.tree.map(lambda new, old: jnp.where(last.impossible <= MOST_IMPOSSIBLE, new, old), split_up, position)


class Reweighted(NamedTuple):
    """Particles after a step, with normalised log-weights. `log_increment` is the log of the mean weight before normalisation."""

    particles: Any
    log_weights: LogWeights
    log_increment: Scalar
    info: Any


def feynman_kac_step(
    key: Key,
    particles: Any,
    log_weights: LogWeights,
    move: Callable[[Keys, Any], tuple[Any, Any]],
    log_potential: Callable[[Any], LogWeights],
    resample: Resample,
    resampled: int,
) -> Reweighted:
    """Resample, move and reweight particles (`blackjax.smc.base.step`).

    Args:
        key: random key.
        particles: pytree with a leading particle axis.
        log_weights: log-weights of the particles, normalised or not.
        move: (keys, resampled particles) -> as many particles as `particles`, and information.
        log_potential: computes the new log-weights of all moved particles.
        resample: a resampling scheme.
        resampled: number of resampled particles; less than the number of particles if `move` returns several states of each.
    """
    from blackjax.smc import base

    weights = jnp.exp(log_weights - jnp.max(log_weights))
    state = base.SMCState(particles, weights / jnp.sum(weights), {})

    def ancestors(resampling_key: Key, weights: Array, count: int | Array) -> Array:
        return resample(resampling_key, jnp.log(weights), int(count))

    def update(keys: Keys, parents: Any, _: Any) -> tuple[Any, Any]:
        return move(keys, parents)

    # blackjax calls the functions with these arguments, although it declares others.
    next_state, info = cast(Any, base.step)(key, state, update, log_potential, ancestors, resampled)
    return Reweighted(next_state.particles, jnp.log(next_state.weights), info.log_likelihood_increment, info.update_info)
