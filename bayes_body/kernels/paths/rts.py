r"""The backward step of the Rauch-Tung-Striebel smoother on a filter's moments, in unconstrained coordinates.

Let a filter's particles have the mean m and the covariance P in a frame. The motion prior predicts the next frame with the mean a, the covariance V
and the covariance C of the two frames (Gauss-Hermite quadrature, density/gaussian_view.py). A path that is at v in the next frame continues backwards
at

$$u = m + G (v - a) + \epsilon, \qquad G = C V^{-1}, \quad \epsilon \sim \mathcal{N}(0,\ P - G V G^\top).$$

If everything is normal, this is a draw from the posterior of all frames. The noise of all paths together has exactly this covariance, and none with
v: so the moments of the paths have no noise of their own, which would add up over the frames. No image is read, and nothing is evaluated but the
prior.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from bayes_body.base.shapes import Key
from bayes_body.density.ahead import sampled_of
from bayes_body.density.chart import Chart
from bayes_body.density.coordinates import coordinates_after
from bayes_body.density.factor import Particles, State, Transition
from bayes_body.density.gaussian_view import moments_after
from bayes_body.kernels.laplace.proposal import balanced_noise
from bayes_body.kernels.paths.ensemble import Flat, flat_coordinates

# Added to variances, relative, so that covariances have roots in float32.
FLOOR = 1e-5


def last_states(key: Key, particles: Particles, paths: int, transition: Transition) -> dict[str, Array]:
    """Return whole states of all paths in the last frame, normal with the moments of the particles: (path, ...)."""
    flat, weights, u = _positions(particles, transition, _chart(particles, transition))
    mean = weights @ u
    root = _root(_covariance(weights, u - mean, u - mean))
    return jax.vmap(lambda row: transition.with_derived(flat.sampled(row)))(mean + balanced_noise(key, paths, u.shape[1]) @ root.T)


def states_before(key: Key, particles: Particles, nexts: State, transition: Transition) -> dict[str, Array]:
    """Return whole states of all paths in a frame (path, ...), given those of the next frame.

    Args:
        key: random key.
        particles: the particles of the frame.
        nexts: the states of the paths in the next frame.
        transition: a motion prior with quantiles, whose memory is one frame.
    """
    chart = _chart(particles, transition)
    flat, weights, u = _positions(particles, transition, chart)
    means, variances = jax.vmap(lambda state: moments_after(transition, chart, flat.unwound(state)))(dict(particles.states))
    mean, predicted = weights @ u, weights @ means
    P, C = (_covariance(weights, u - mean, other) for other in (u - mean, means - predicted))
    V = _covariance(weights, means - predicted, means - predicted) + jnp.diag(weights @ variances)
    gain, conditional = _given_next(P, C, V)
    root = _root(conditional, jnp.diagonal(P))
    v = jax.vmap(lambda state: flat.vector(sampled_of(transition, state)))(dict(nexts))
    centre, noise = jnp.mean(v, axis=0), noise_beside(key, v)
    # There are many paths: the maps of v and of the noise are multiplied first.
    by_next, by_noise = gain + root @ noise.by_next, root @ noise.by_noise
    moved = mean + gain @ (centre - predicted) + (v - centre) @ by_next.T + noise.numbers @ by_noise.T
    return jax.vmap(lambda row: transition.with_derived(flat.sampled(row)))(moved)


def _given_next(
    P: Float[Array, "dof dof"], C: Float[Array, "dof dof"], V: Float[Array, "dof dof"]
) -> tuple[Float[Array, "dof dof"], Float[Array, "dof dof"]]:
    """Return the gain, and the covariance of a frame given the next one."""
    gain = jax.scipy.linalg.cho_solve((_root(V), True), C.T).T
    return gain, P - gain @ V @ gain.T


class Beside(NamedTuple):
    """Noise of paths beside their next states v: `numbers @ by_noise.T + (v - mean of v) @ by_next.T`.

    Attributes:
        numbers: standard normal numbers.
        by_noise: their map.
        by_next: the map of v.
    """

    numbers: Float[Array, "path dof"]
    by_noise: Float[Array, "dof dof"]
    by_next: Float[Array, "dof dof"]


def noise_beside(key: Key, v: Float[Array, "path dof"]) -> Beside:
    """Return noise whose mean over all paths is 0, whose covariance is I, and which is not correlated with the next states v.

    With too few paths for these moments, or if the next states have no covariance, it is independent noise.
    """
    count, size = v.shape
    # As one row: in rows of a length that is no multiple of eight, the numbers take a third longer.
    numbers = jax.random.normal(key, (count * size,), v.dtype).reshape(v.shape)
    identity, zero = jnp.eye(size, dtype=v.dtype), jnp.zeros((size, size), v.dtype)
    if count < 2 * (2 * size + 1):
        return Beside(numbers, identity, zero)
    numbers -= jnp.mean(numbers, axis=0)
    equal, centred = jnp.full(count, 1 / count, v.dtype), v - jnp.mean(v, axis=0)
    spread, cross, square = (_covariance(equal, *pair) for pair in ((centred, centred), (numbers, centred), (numbers, numbers)))
    slope = jax.scipy.linalg.cho_solve((_root(spread), True), cross.T).T
    beside = square - slope @ cross.T - cross @ slope.T + slope @ spread @ slope.T
    by_noise = jax.scipy.linalg.solve_triangular(jnp.linalg.cholesky(beside), identity, lower=True)
    by_next = -by_noise @ slope
    exist = jnp.all(jnp.isfinite(by_noise)) & jnp.all(jnp.isfinite(by_next))
    return Beside(numbers, jnp.where(exist, by_noise, identity), jnp.where(exist, by_next, zero))


def _chart(particles: Particles, transition: Transition) -> Chart:
    return coordinates_after(transition, jax.tree.map(lambda leaf: leaf[0], dict(particles.states)))


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
