r"""The ladder of tempered SMC: the powers of its stages, and how the next powers are found.

The powers are those of the prior's potentials, $\alpha$, and of the likelihood, $\beta$. First $\alpha$ goes from 0 to 1, then $\beta$.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from bayes_body.base.shapes import Flag, Index, Scalar
from bayes_body.density.tempering import LogTerms
from bayes_body.kernels.weights import LogWeights, normalise


class Ladder(NamedTuple):
    """The powers of a run, and the log step size and whitening of the moves at each. Entries of unused stages are NaN.

    The powers are those of the likelihood (`inverse_temperatures`) and of the prior's potentials, which reach 1 first.
    """

    inverse_temperatures: Float[Array, " stage"]
    potential_powers: Float[Array, " stage"]
    log_step_sizes: Float[Array, " stage"]
    whitening: dict[str, Float[Array, "stage dof dof"]]

    def with_powers(self, stage: Index, powers: LogTerms) -> "Ladder":
        """Return the ladder with the powers that a stage reached entered."""
        return self._replace(
            inverse_temperatures=self.inverse_temperatures.at[stage].set(powers.likelihood),
            potential_powers=self.potential_powers.at[stage].set(powers.potential),
        )

    def with_moves(self, stage: Index, log_step_size: Scalar, whitening: dict[str, Float[Array, "dof dof"]]) -> "Ladder":
        """Return the ladder with the moves of a stage entered."""
        roots = {name: self.whitening[name].at[stage].set(root) for name, root in whitening.items()}
        return self._replace(log_step_sizes=self.log_step_sizes.at[stage].set(log_step_size), whitening=roots)

    def increment(self, powers: LogTerms, stage: Index) -> LogTerms:
        """Return the step of both powers that this ladder prescribes for a stage."""
        return LogTerms(self.inverse_temperatures[stage] - powers.likelihood, self.potential_powers[stage] - powers.potential)


def increment(terms: LogTerms, powers: LogTerms, target_ess: float, is_last: Flag) -> LogTerms:
    """Return the step of both powers: of the potentials' until it is 1, then of the likelihood's. The last stage goes to 1 in both.

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
    """Return the share of a stage's evidence that belongs to the potentials: all of it on the first rung, none on the second.

    If too few stages are left, the last one climbs the rest of both rungs at once, and only the likelihood's share is evidence.
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
