r"""The inverse mass matrix of Hamiltonian Monte Carlo from curvatures at one state (Poon & Fleet 2002, (18), (22), (23)).

With the variance $v_k$ of the process noise and the curvature $c_k$ of the log-likelihood along dof k, in the coordinates x that are sampled,

$$\frac{1}{\epsilon_k^2} = \Big(\frac{\partial s_k}{\partial x_k}\Big)^2 \Big(\frac{1}{v_k} + c_k\Big)
  - \frac{\partial^2}{\partial x_k^2} \log \Big|\frac{\partial s_k}{\partial x_k}\Big|, \qquad M^{-1} = \mathrm{diag}(\epsilon_k^2).$$

A likelihood may offer $c_k$ (`Factor.curvature`); else it is found by finite differences of its gradient over a tenth of the noise's deviation, and
counts where it is positive. The matrix depends on the chain's first state only: the moves stay reversible. Dense, the ε_k are kept, and correlations
are those of the particles of the frame before.
"""

from typing import Any

import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float

from bayes_body.factor import FrameDensity, State

# Over which share of the noise's deviation a gradient is differenced.
DIFFERENCE = 0.1
# How much of the particles' correlations is believed.
BELIEVED = 0.9


def inverse_mass(density: FrameDensity, position: State, previous: State) -> Float[Array, " dof"]:
    """The diagonal of M⁻¹ at a position, coordinates without limits; its variables one after the other in alphabetical order.

    Args:
        density: of the frame.
        position: where a chain starts.
        previous: the state of the frame before that it was predicted from.
    """
    target = density.unconstrained()
    state = target.constrain(position)
    variances = {name: jnp.asarray(law.variance) for name, law in density.transition.conditional(previous).items()}
    found = density.curvature(state, previous)
    curvatures = differenced(density, state, previous, variances) if found is None else found
    scales = {}
    for name, x in position.items():
        slope, bend = _slope_and_bend(target.bijections[name], x)
        likelihood = jnp.maximum(jnp.where(jnp.isfinite(curvatures[name]), curvatures[name], 0.0), 0.0)
        scales[name] = 1 / (slope * slope * (1 / variances[name] + likelihood) + bend)
    return ravel_pytree(scales)[0]


def _slope_and_bend(bijection: Any, x: Array) -> tuple[Array, Array]:
    """∂s/∂x of a bijection that acts on each entry alone, and minus the second derivative of its logarithm where that is positive."""
    ones = jnp.ones_like(x)

    def slope(x: Array) -> Array:
        return jax.jvp(bijection, (x,), (ones,))[1]

    def log_slope(x: Array) -> Array:
        # A limit reached to the last bit has no slope left.
        return jnp.log(jnp.maximum(jnp.abs(slope(x)), jnp.finfo(x.dtype).tiny))

    def first(x: Array) -> Array:
        return jax.jvp(log_slope, (x,), (ones,))[1]

    return slope(x), jnp.maximum(-jax.jvp(first, (x,), (ones,))[1], 0.0)


def differenced(density: FrameDensity, state: State, previous: State, variances: State) -> dict[str, Array]:
    """Curvatures of the log-likelihood along each dof, from gradients on both sides of a state."""
    flat, unravel = ravel_pytree(dict(state))
    reach = DIFFERENCE * jnp.sqrt(ravel_pytree(dict(variances))[0])

    def gradient(values: Array) -> Array:
        return jax.grad(lambda v: density.log_likelihood({**previous, **unravel(v)}, previous))(values)

    def along(number: Array) -> Array:
        step = jnp.zeros_like(flat).at[number].set(reach[number])
        ahead, behind = jax.lax.map(gradient, jnp.stack([flat + step, flat - step]))
        return -(ahead[number] - behind[number]) / (2 * reach[number])

    return unravel(jax.lax.map(along, jnp.arange(flat.shape[0])))


def dense(diagonal: Float[Array, " dof"], particles: Float[Array, "particle dof"], weights: Float[Array, " particle"]) -> Float[Array, "dof dof"]:
    """The diagonal's scales with the correlations of weighted particles, coordinates without limits."""
    weights = weights / jnp.sum(weights)
    centred = particles - weights @ particles
    covariance = (weights[:, None] * centred).T @ centred
    deviations = jnp.sqrt(jnp.diagonal(covariance))
    # Particles that are all the same, as at a first frame, have no correlations.
    spread = deviations > 1e-6 * jnp.sqrt(diagonal)
    safe = jnp.where(spread, deviations, 1.0)
    correlation = jnp.where(spread[:, None] & spread[None, :], covariance / (safe[:, None] * safe[None, :]), 0.0)
    off = ~jnp.eye(diagonal.shape[0], dtype=bool)
    scales = jnp.sqrt(diagonal)
    return jnp.where(off, BELIEVED * correlation, 1.0) * scales[:, None] * scales[None, :]
