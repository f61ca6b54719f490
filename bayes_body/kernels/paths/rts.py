r"""The backward step of the Rauch-Tung-Striebel smoother on a filter's moments, in unconstrained coordinates.

Let a filter's particles have the mean m and the covariance P in a frame. The motion prior predicts the next frame with the mean a, the covariance V
and the covariance C of the two frames (Gauss-Hermite quadrature, density/gaussian_view.py). A path that is at v in the next frame continues backwards
at

$$u = m + G (v - a) + \epsilon, \qquad G = C V^{-1}, \quad \epsilon \sim \mathcal{N}(0,\ P - G V G^\top).$$

If everything is normal, this is a draw from the posterior of all frames. The noise of all paths together has exactly this covariance, and none with
v: so the moments of the paths have no noise of their own, which would add up over the frames. No image is read, and nothing is evaluated but the
prior.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from bayes_body.base.shapes import Key
from bayes_body.density.chart import Chart
from bayes_body.density.factor import Particles, State, Transition
from bayes_body.density.gaussian_view import moments_after
from bayes_body.kernels.laplace.proposal import balanced_noise
from bayes_body.kernels.paths.ensemble import Flat, flat_coordinates
from bayes_body.kernels.smc.moment_correction import noise_beside

# Added to variances, relative, so that covariances have roots in float32.
FLOOR = 1e-5


def last_states(key: Key, particles: Particles, paths: int, transition: Transition, chart: Chart) -> dict[str, Array]:
    """Return the sampled variables of all paths in the last frame, normal with the moments of the particles: (path, ...)."""
    flat, weights, u = _positions(particles, transition, chart)
    mean = weights @ u
    root = _root(_covariance(weights, u - mean, u - mean))
    return jax.vmap(flat.sampled)(mean + balanced_noise(key, paths, u.shape[1]) @ root.T)


def states_before(key: Key, particles: Particles, nexts: State, transition: Transition, chart: Chart) -> dict[str, Array]:
    """Return the sampled variables of all paths in a frame (path, ...), given those of the next frame.

    Args:
        key: random key.
        particles: the particles of the frame.
        nexts: the sampled variables of the paths in the next frame.
        transition: a motion prior with quantiles, whose memory is one frame.
        chart: the unconstrained coordinates.
    """
    flat, weights, u = _positions(particles, transition, chart)
    means, variances = jax.vmap(lambda state: moments_after(transition, chart, flat.unwound(state)))(dict(particles.states))
    mean, predicted = weights @ u, weights @ means
    P, C = (_covariance(weights, u - mean, other) for other in (u - mean, means - predicted))
    V = _covariance(weights, means - predicted, means - predicted) + jnp.diag(weights @ variances)
    V_root = _root(V)
    gain = jax.scipy.linalg.cho_solve((V_root, True), C.T).T
    root = _root(P - gain @ V @ gain.T, jnp.diagonal(P))
    v = jax.vmap(flat.vector)(dict(nexts))
    noise = noise_beside(key, v, jnp.zeros(len(v), v.dtype), u.shape[1])
    return jax.vmap(flat.sampled)(mean + (v - predicted) @ gain.T + noise @ root.T)


def _positions(particles: Particles, transition: Transition, chart: Chart) -> tuple[Flat, Float[Array, " particle"], Float[Array, "particle dof"]]:
    """Return the maps to coordinates, the weights, and the coordinates of the particles."""
    flat = flat_coordinates(particles, transition, chart)
    return flat, jax.nn.softmax(particles.log_weights), jax.vmap(flat.vector_of_state)(dict(particles.states))


def _covariance(
    weights: Float[Array, " particle"], one: Float[Array, "particle dof"], other: Float[Array, "particle dof"]
) -> Float[Array, "dof dof"]:
    return (weights[:, None] * one).T @ other


def _root(covariance: Float[Array, "dof dof"], scale: Float[Array, " dof"] | None = None) -> Float[Array, "dof dof"]:
    """Return a root, with a floor relative to the variances, or to others if a difference of covariances may have none left."""
    return jnp.linalg.cholesky(covariance + FLOOR * jnp.diag(jnp.diagonal(covariance) if scale is None else scale))
