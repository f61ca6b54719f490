r"""Hamiltonian Monte Carlo on the Gaussian view of a frame (density/gaussian_view.py), in the whitened coordinates of the prediction.

The prediction is one Gaussian, so no draw has an ancestor, and what hardly moves keeps its spread from frame to frame. In the mixture of the marginal
view, all draws of such a variable descend from a few after some frames. The inverse mass matrix is that of the curvature at the start,

$$M^{-1} = (I + C)^{-1}, \qquad C = -\partial^2 \log(L \psi C) / \partial z^2,$$

by differences of gradients, with eigenvalues of M of at least `LEAST`.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from bayes_body.base.shapes import Flag, Key, Scalar
from bayes_body.density.density import Density
from bayes_body.density.factor import State
from bayes_body.density.gaussian_view import GaussianView
from bayes_body.kernels.batching import over_particles
from bayes_body.kernels.hmc.hamiltonian import LogDensity
from bayes_body.kernels.hmc.mass import DIFFERENCE, LEAST, finite, hessian
from bayes_body.kernels.weights import Resample, predict_by_gaussian

# The name of the position of a chain: the whitened coordinates.
NOISE = "noise"


class GaussianStart(NamedTuple):
    """The Gaussian view, the whitened coordinates of the starts, and what the draws say that they are chosen from: the evidence, and a loss."""

    view: GaussianView
    positions: dict[str, Float[Array, "chain dof"]]
    log_evidence: Scalar
    lost: Flag


def gaussian_starts(key: Key, density: Density, count: int, chains: int, resample: Resample) -> GaussianStart:
    """Choose starts by weight among draws of the Gaussian prediction.

    Args:
        key: random key.
        density: the density of the frame, with the particles of the previous one.
        count: number of draws.
        chains: number of starts.
        resample: a resampling scheme.

    Raises:
        InputError: a Gaussian cannot predict this model's states (`gaussian_view`).
    """
    draw_key, resample_key = jax.random.split(key)
    view, drawn = predict_by_gaussian(draw_key, jnp.zeros(count, jnp.int32), density)
    weights = drawn.normalised()
    chosen = resample(resample_key, weights.log_weights, chains)
    noise = jax.vmap(lambda state: view.whitened(view.position(state)))(jax.tree.map(lambda leaf: leaf[chosen], dict(drawn.states)))
    return GaussianStart(view, {NOISE: noise}, drawn.log_evidence(), weights.lost)


def gaussian_target(view: GaussianView) -> LogDensity:
    """Return the log-density of whitened coordinates."""
    return lambda position: view.log_density_at(position[NOISE])


def gaussian_mass(view: GaussianView, start: State, is_dense: bool) -> Float[Array, " dof *dof"]:
    """Return the inverse mass matrix at a start, or its diagonal."""
    noise = start[NOISE]
    curvature = finite(hessian(jax.grad(view.log_density_at), noise, jnp.full_like(noise, DIFFERENCE)))
    if not is_dense:
        return 1 / jnp.maximum(jnp.diagonal(curvature), LEAST)
    values, vectors = jnp.linalg.eigh(curvature)
    return (vectors / jnp.maximum(values, LEAST)) @ vectors.T


def gaussian_states(key: Key, noise: Float[Array, "draw dof"], view: GaussianView) -> State:
    """Return the whole states at whitened coordinates; variables that no factor reads are drawn given the others."""

    def complete(row: Array, view: GaussianView) -> State:
        unread, read = row[: view.unread_size], row[view.unread_size :]
        return view.completed(unread, jnp.zeros((), jnp.int32), view.draw(read))

    unread = jax.random.normal(key, (noise.shape[0], view.unread_size), noise.dtype)
    return over_particles(complete, jnp.concatenate([unread, noise], axis=1), view)
