r"""The prior of the first frames of a window as one Gaussian in unconstrained coordinates, fitted to what the motion prior predicts from particles.

The exact prior is a mixture with a component for each particle of the frame before the window (density/trajectory.py). In many dimensions these
components are far apart: the posterior has as many modes, and chains do not pass between them. The Gaussian has the mixture's mean and covariance. It
is the prior that a filter with `prediction = "gaussian"` uses from frame to frame (density/gaussian_view.py).

The memory of the motion prior is the number of frames that read the particles. The Gaussian is over all these frames together. Its entries are the
coordinates of the first frame and the steps to the next ones. A step varies far less than its starting point. In the covariance of the coordinates
themselves, its variance would be lost in rounding.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float

from bayes_body.base.errors import input_error
from bayes_body.base.shapes import Key, Scalar
from bayes_body.density.ahead import sampled_of
from bayes_body.density.coordinates import coordinates_after
from bayes_body.density.factor import Particles, State, Transition
from bayes_body.density.gaussian_view import TRANSITIONS, fitted_gaussian


class WindowPrior(NamedTuple):
    """The Gaussian over the first frames of a window. Create it with `window_prior`.

    Attributes:
        mean: the mean of the coordinates of the first frame, then of the steps.
        inverse_root: the inverse of a lower triangular root of the covariance.
    """

    mean: Float[Array, " entry"]
    inverse_root: Float[Array, "entry entry"]

    def log_density(self, coordinates: Float[Array, "frame dof"]) -> Scalar:
        """Return the log-density of the coordinates of the first frames. It is a density over coordinates, so no Jacobian is added."""
        noise = self.inverse_root @ (_steps(coordinates) - self.mean)
        return jnp.sum(jnp.log(jnp.diagonal(self.inverse_root))) - 0.5 * jnp.sum(noise * noise) - 0.5 * noise.size * jnp.log(2 * jnp.pi)


def window_prior(key: Key, transition: Transition, previous: Particles, references: State) -> WindowPrior:
    """Return the Gaussian over as many frames as there are references.

    Args:
        key: random key of the draws.
        transition: the motion prior.
        previous: the weighted particles of the frame before the window.
        references: (frame, ...), for each frame a state of the previous frame, around which its coordinates are defined.

    Raises:
        InputError: the motion prior remembers all earlier frames.
    """
    if transition.frames_read is None:
        problem = f"the dynamics '{transition.name}' remember all frames before"
        raise input_error("a Gaussian prior of a window", problem, "dynamics that read a few frames", "choose a model with other dynamics")
    return _fitted(key, transition, previous, references)


@jax.jit
def _fitted(key: Key, transition: Transition, previous: Particles, references: State) -> WindowPrior:
    weights = jax.nn.softmax(previous.log_weights) / TRANSITIONS

    def path(key: Key, state: State) -> Float[Array, " entry"]:
        def step(state: State, turn: tuple[Key, State]) -> tuple[State, Array]:
            next_state = transition.sample(turn[0], state)
            unwrapped = transition.near(sampled_of(transition, next_state), turn[1])
            return next_state, ravel_pytree(coordinates_after(transition, turn[1]).unconstrain(unwrapped))[0]

        frames = jax.tree.leaves(dict(references))[0].shape[0]
        return _steps(jax.lax.scan(step, dict(state), (jax.random.split(key, frames), dict(references)))[1])

    def draw_paths(key: Key, state: State) -> Float[Array, "draw entry"]:
        return jax.vmap(path, in_axes=(0, None))(jax.random.split(key, TRANSITIONS), state)

    drawn = jax.vmap(draw_paths)(jax.random.split(key, weights.shape[0]), dict(previous.states))
    mean, _, inverse_root = fitted_gaussian(weights, drawn)
    return WindowPrior(mean, inverse_root)


def _steps(coordinates: Float[Array, "frame dof"]) -> Float[Array, " entry"]:
    """Return the coordinates of the first frame, and the step from each frame to the next."""
    return jnp.concatenate([coordinates[:1], jnp.diff(coordinates, axis=0)]).ravel()
