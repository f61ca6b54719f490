r"""Unconstrained coordinates: for each sampled variable, a bijection $x \mapsto s(x)$ onto the support of its distribution.

The Jacobian converts a density over the state to one over the coordinates: $\log p(x) = \log p(s(x)) + \log |\det \partial s / \partial x|$.
"""

from collections.abc import Mapping
from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array
from numpyro.distributions import Distribution, biject_to
from numpyro.distributions.transforms import Transform

from bayes_body.base.shapes import Scalar
from bayes_body.density.chart import Chart
from bayes_body.density.factor import State, Transition


class Coordinates(NamedTuple):
    """The map between a state's sampled variables and unconstrained coordinates (a position)."""

    bijections: dict[str, Transform]

    def constrain(self, position: State) -> dict[str, Array]:
        """Return the sampled variables at a position."""
        return {name: jnp.asarray(self.bijections[name](value)) for name, value in position.items()}

    def unconstrain(self, state: State) -> dict[str, Array]:
        """Return the position of a state, the inverse of `constrain`. Variables that are not sampled are left out."""
        return {name: jnp.asarray(bijection.inv(state[name])) for name, bijection in self.bijections.items()}

    def log_determinant(self, position: State) -> Scalar:
        """Return log |det ds/dx|, which is added to a log-density of the state to give the log-density of the position."""
        state = self.constrain(position)
        terms = (jnp.sum(self.bijections[name].log_abs_det_jacobian(x, state[name])) for name, x in position.items())
        return sum(terms, jnp.zeros(()))


def coordinates_of(distributions: Mapping[str, Distribution]) -> Coordinates:
    """Return the coordinates for the supports of these distributions, one per variable."""
    return Coordinates({name: biject_to(distribution.support) for name, distribution in distributions.items()})


def coordinates_after(transition: Transition, previous_state: State) -> Chart:
    """Return the unconstrained coordinates of the states after a state."""
    return coordinates_of(transition.conditional(previous_state)) if transition.chart is None else transition.chart(previous_state)
