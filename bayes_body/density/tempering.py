r"""The terms of a density that a kernel may temper, and the rule by which all views temper them."""

from typing import NamedTuple

import jax.numpy as jnp

from bayes_body.base.shapes import Scalar


class LogTerms(NamedTuple):
    """The terms that a kernel may temper: log L, and log ψ of the prior's potentials."""

    likelihood: Scalar
    potential: Scalar


def tempered(inverse_temperature: float | Scalar, log_likelihood: Scalar) -> Scalar:
    """Return β log L, but 0 at β = 0 for every likelihood, since 0 · (-inf) would be NaN."""
    hot = jnp.asarray(inverse_temperature) == 0
    return jnp.where(hot, 0.0, inverse_temperature * jnp.where(hot, 0.0, log_likelihood))
