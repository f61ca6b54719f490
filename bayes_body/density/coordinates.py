r"""Coordinates without limits: a bijection $x \mapsto s(x)$ for each sampled variable, onto the support of its distribution.

A density over the state becomes one over the coordinates by the Jacobian: $\log p(x) = \log p(s(x)) + \log |\det \partial s / \partial x|$.
"""

from collections.abc import Mapping
from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array
from numpyro.distributions import Distribution, biject_to
from numpyro.distributions.transforms import Transform

from bayes_body.density.factor import State
from bayes_body.shapes import Scalar


class Coordinates(NamedTuple):
    """The map between a state's sampled variables and coordinates without limits (a position)."""

    bijections: dict[str, Transform]

    def constrain(self, position: State) -> dict[str, Array]:
        """The sampled variables at a position."""
        return {name: jnp.asarray(self.bijections[name](value)) for name, value in position.items()}

    def unconstrain(self, state: State) -> dict[str, Array]:
        """The position of a state, the inverse of `constrain`; variables that are not sampled are left out."""
        return {name: jnp.asarray(bijection.inv(state[name])) for name, bijection in self.bijections.items()}

    def log_determinant(self, position: State) -> Scalar:
        """log |det ds/dx|: without it the density would be over x, not over the state."""
        state = self.constrain(position)
        terms = (jnp.sum(self.bijections[name].log_abs_det_jacobian(x, state[name])) for name, x in position.items())
        return sum(terms, jnp.zeros(()))


def coordinates_of(distributions: Mapping[str, Distribution]) -> Coordinates:
    """The coordinates that belong to the supports of these distributions, one a variable."""
    return Coordinates({name: biject_to(distribution.support) for name, distribution in distributions.items()})
