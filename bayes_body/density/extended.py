r"""The extended view of a frame's posterior: the ancestor is a variable too, and states are in coordinates without limits.

$$\log \pi_\beta(i, x) = \log w_i + \log p(s(x) \mid s^i_{t-1}) + \log C + \beta \log L + \log |\det \partial s / \partial x|.$$

Particle methods use it: after one ancestor a density costs one transition, while the marginal view (`Density.unconstrained`) costs one for each
particle of the frame before. A Gibbs step redraws the ancestor.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from bayes_body.density.coordinates import Coordinates
from bayes_body.density.density import Density
from bayes_body.density.factor import State
from bayes_body.shapes import Index, Key, Scalar


class Extended(NamedTuple):
    """The extended view; make it with `extended`.

    Attributes:
        density: of the frame.
        coordinates: without limits; the same after every ancestor.
        cumulative_weights: of the particles of the frame before, not normalised.
    """

    density: Density
    coordinates: Coordinates
    cumulative_weights: Float[Array, " particle"]

    def state(self, ancestor: Index, position: State) -> State:
        """The whole state at a position, with what it carries along from its ancestor."""
        return self.density.transition.carry(self.density.ancestor(ancestor), self.coordinates.constrain(position))

    def log_likelihood(self, ancestor: Index, position: State) -> Scalar:
        """The likelihood side."""
        return self.density.log_likelihood(self.state(ancestor, position), self.density.ancestor(ancestor))

    def log_density(self, ancestor: Index, position: State, inverse_temperature: float | Scalar = 1.0) -> tuple[Scalar, Scalar]:
        """log π_β(i, x) less log w_i, which is constant while the ancestor is; and the log-likelihood."""
        log_joint, log_likelihood = self.density.log_joint(self.state(ancestor, position), self.density.ancestor(ancestor), inverse_temperature)
        return log_joint + self.coordinates.log_determinant(position), log_likelihood

    def choose_ancestor(self, key: Key, ancestor: Index, position: State, inverse_temperature: float | Scalar, candidates: int) -> Index:
        """An ancestor from p(i | x), exactly, by iterated sampling importance resampling (Andrieu, Lee & Vihola 2018).

        The present ancestor competes with `candidates` - 1 others. These are drawn by their weights; the choice is by how well the state follows.

        Args:
            key: of the draw.
            ancestor: the present one.
            position: of the state.
            inverse_temperature: of the target.
            candidates: how many compete, the present one included.
        """
        count = self.cumulative_weights.shape[0]
        if candidates == 1 or count == 1:
            return ancestor
        draw_key, choose_key = jax.random.split(key)
        levels = self.cumulative_weights[-1] * jax.random.uniform(draw_key, (candidates - 1,), self.cumulative_weights.dtype)
        others = jnp.minimum(jnp.searchsorted(self.cumulative_weights, levels, side="right"), count - 1)
        competing = jnp.concatenate([ancestor[None], others.astype(ancestor.dtype)])
        log_probs = jax.vmap(lambda one: self._given_ancestor(one, position, inverse_temperature))(competing)
        # NaN: an ancestor that the state cannot come from.
        return competing[jax.random.categorical(choose_key, jnp.where(jnp.isnan(log_probs), -jnp.inf, log_probs))]

    def _given_ancestor(self, ancestor: Index, position: State, inverse_temperature: float | Scalar) -> Scalar:
        """The terms of log π_β(i, x) - log w_i that depend on the ancestor: all of them only where a factor reads the frame before."""
        if self.density.reads_previous:
            return self.log_density(ancestor, position, inverse_temperature)[0]
        return self.density.transition.log_density(self.state(ancestor, position), self.density.ancestor(ancestor))


def extended(density: Density) -> Extended:
    """The extended view of a density, after the particles that it holds as the frame before."""
    log_weights = density.previous.log_weights
    return Extended(density, density.coordinates(), jnp.cumsum(jnp.exp(log_weights - jnp.max(log_weights))))
