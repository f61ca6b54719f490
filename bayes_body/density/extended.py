r"""The extended view of a frame's posterior: the ancestor is a variable too, and states are in unconstrained coordinates.

$$\log \pi_{\alpha\beta}(i, x) = \log w_i + \log p(s(x) \mid s^i_{t-1}) + \log C + \alpha \log \psi + \beta \log L
  + \log |\det \partial s / \partial x|.$$

Particle methods use it. Given one ancestor, a density costs one transition, while the marginal view (`Density.unconstrained`) costs one for each
particle of the previous frame. A Gibbs step redraws the ancestor.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from bayes_body.base.inverse_cdf import inverse_cdf
from bayes_body.base.shapes import Index, Key, Scalar
from bayes_body.density.chart import Chart
from bayes_body.density.density import Density
from bayes_body.density.factor import State
from bayes_body.density.tempering import LogTerms


class Extended(NamedTuple):
    """The extended view. Create it with `extended`.

    Attributes:
        density: the density of the frame.
        coordinates: the unconstrained coordinates, the same for every ancestor.
        cumulative_weights: cumulative sum of the weights of the previous frame's particles, not normalised.
    """

    density: Density
    coordinates: Chart
    cumulative_weights: Float[Array, " particle"]

    def state(self, ancestor: Index, position: State) -> State:
        """Return the whole state at a position, with the variables that it takes from its ancestor."""
        return self.density.transition.state(self.density.ancestor(ancestor), self.coordinates.constrain(position))

    def position(self, state: State) -> dict[str, Array]:
        """Return the position of a state."""
        return self.coordinates.unconstrain(state)

    def terms(self, ancestor: Index, position: State) -> LogTerms:
        """Return the log-likelihood, and the log-potential of the prior."""
        state, previous = self.state(ancestor, position), self.density.ancestor(ancestor)
        return LogTerms(self.density.log_likelihood(state, previous), self.density.log_potential(state, previous))

    def log_density(
        self, ancestor: Index, position: State, inverse_temperature: float | Scalar = 1.0, potential_power: float | Scalar = 1.0
    ) -> tuple[Scalar, LogTerms]:
        """Return log π_αβ(i, x) - log w_i, and both tempered terms. log w_i is constant as long as the ancestor does not change."""
        state, previous = self.state(ancestor, position), self.density.ancestor(ancestor)
        log_joint, terms = self.density.log_joint(state, previous, inverse_temperature, potential_power)
        return log_joint + self.coordinates.log_determinant(position), terms

    def choose_ancestor(
        self,
        key: Key,
        ancestor: Index,
        position: State,
        inverse_temperature: float | Scalar,
        candidates: int,
        potential_power: float | Scalar = 1.0,
    ) -> Index:
        """Redraw the ancestor by iterated sampling importance resampling (Andrieu, Lee & Vihola 2018), which leaves p(i | x) exactly invariant.

        The current ancestor competes with `candidates` - 1 others, which are drawn by weight. One is chosen in proportion to the density of the state
        given that ancestor.

        Args:
            key: random key.
            ancestor: the current ancestor.
            position: the position of the state.
            inverse_temperature: β of the target.
            candidates: the number of competing ancestors, including the current one.
            potential_power: α of the target.
        """
        count = self.cumulative_weights.shape[0]
        if candidates == 1 or count == 1:
            return ancestor
        draw_key, choose_key = jax.random.split(key)
        levels = jax.random.uniform(draw_key, (candidates - 1,), self.cumulative_weights.dtype)
        rivals = inverse_cdf(self.cumulative_weights, levels)
        competing = jnp.concatenate([ancestor[None], rivals.astype(ancestor.dtype)])
        log_probs = jax.vmap(lambda candidate: self._given_ancestor(candidate, position, inverse_temperature, potential_power))(competing)
        # NaN marks an ancestor from which the state cannot come.
        return competing[jax.random.categorical(choose_key, jnp.where(jnp.isnan(log_probs), -jnp.inf, log_probs))]

    def _given_ancestor(self, ancestor: Index, position: State, inverse_temperature: float | Scalar, potential_power: float | Scalar) -> Scalar:
        """Return the terms of log π_αβ(i, x) - log w_i that depend on the ancestor: all if a factor reads the previous frame, else the transition."""
        if self.density.reads_previous:
            return self.log_density(ancestor, position, inverse_temperature, potential_power)[0]
        return self.density.transition.log_density(self.state(ancestor, position), self.density.ancestor(ancestor))


def extended(density: Density) -> Extended:
    """Return the extended view of a density, given the particles of its previous frame."""
    log_weights = density.previous.log_weights
    return Extended(density, density.coordinates(), jnp.cumsum(jnp.exp(log_weights - jnp.max(log_weights))))
