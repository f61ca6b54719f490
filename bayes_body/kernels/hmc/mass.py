r"""The inverse mass matrix of Hamiltonian Monte Carlo, from curvatures at one state (Poon & Fleet 2002, (18), (22), (23)).

Let $v$ be the variances of the process noise, $C$ the matrix of minus the second derivatives of the log-likelihood, and
$S = \mathrm{diag}(\partial s_k / \partial x_k)$ the slopes for the sampled coordinates x. Then

$$M = S\, (\mathrm{diag}(1/v) + C)\, S - \mathrm{diag}\Big(\frac{\partial^2}{\partial x_k^2} \log \Big|\frac{\partial s_k}{\partial x_k}\Big|\Big).$$

The paper uses only the diagonal, $M^{-1} = \mathrm{diag}(\epsilon_k^2)$. Monocular posteriors are narrow along some combinations of dofs and wide
along others. With the whole matrix, the narrowest combination does not limit the steps along the others.

A likelihood may supply its part of C (`Factor.curvature`), for the variables that it reads. If these variables are derived from the sampled ones
(`Transition.derive`), the part is pulled back: $J^\top C J$, with the Jacobian J of the derived variables. For the other likelihoods, C comes from
finite differences of their gradient with respect to the sampled variables, with steps of a tenth of the noise's standard deviation. Only positive
curvature is used. The matrix depends only on the first state of the chain, so the moves stay reversible. If the correlations of the previous frame's
particles are used, the scales ε_k do not change.

If the prior has potentials, or if the coordinates are not entrywise (density/chart.py), so that S is not diagonal, M is the curvature of the whole
log-density given the ancestor, by finite differences in the coordinates. In every direction it is at least a tenth of the noise's.
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float
from numpyro.distributions.transforms import Transform

from bayes_body.density.coordinates import Coordinates
from bayes_body.density.density import Density, Unconstrained
from bayes_body.density.factor import State

# Step of the finite difference of the gradient, as a fraction of the noise's standard deviation.
DIFFERENCE = 0.1
# The factor by which the particles' correlations are shrunk.
SHRINKAGE = 0.9
# The smallest curvature of a whole log-density, in units of that of the noise.
LEAST = 0.1


def inverse_mass(target: Unconstrained, position: State, previous: State, is_dense: bool = False) -> Float[Array, " dof *dof"]:
    """Return M⁻¹ at a position (unconstrained coordinates), with the variables in alphabetical order.

    Args:
        target: the marginal view in unconstrained coordinates (`Density.unconstrained`).
        position: the start of a chain.
        previous: the state of the previous frame from which it was predicted.
        is_dense: whether to return the whole matrix rather than the inverse of the diagonal.
    """
    sampled, density = target.coordinates.constrain(position), target.density
    variances = ravel_pytree({name: jnp.asarray(distribution.variance) for name, distribution in density.transition.conditional(previous).items()})[0]
    if density.has_potentials or not isinstance(target.coordinates, Coordinates):
        return _of_target(target, position, previous, variances, is_dense)
    curvature = finite(offered(density, sampled, previous)) + finite(differenced(density, sampled, previous, variances))
    slope, bend = (ravel_pytree(parts)[0] for parts in _slopes_and_bends(target.coordinates, position))
    prior = slope * slope / variances + bend
    if not is_dense:
        return 1 / (prior + slope * slope * jnp.maximum(jnp.diagonal(curvature), 0.0))
    # In units of the prior, the smallest eigenvalue is 1. Negative curvature is left out, since it does not belong to a peak.
    unit = jax.lax.rsqrt(prior)
    scale = unit * slope
    values, vectors = jnp.linalg.eigh(scale[:, None] * curvature * scale)
    return unit[:, None] * ((vectors / (1 + jnp.maximum(values, 0.0))) @ vectors.T) * unit


def _of_target(target: Unconstrained, position: State, previous: State, variances: Float[Array, " dof"], is_dense: bool) -> Float[Array, " dof *dof"]:
    """Return M⁻¹ from differences of the gradient of the whole log-density given one ancestor."""
    flat, unravel = ravel_pytree(dict(position))
    density = target.density

    def log_density(x: Array) -> Array:
        sampled = target.coordinates.constrain(unravel(x))
        return density.log_joint(density.transition.state(previous, sampled), previous)[0] + target.coordinates.log_determinant(unravel(x))

    unit = jnp.sqrt(variances)
    relative = unit[:, None] * finite(hessian(jax.grad(log_density), flat, DIFFERENCE * unit)) * unit
    if not is_dense:
        return variances / jnp.maximum(jnp.diagonal(relative), LEAST)
    values, vectors = jnp.linalg.eigh(relative)
    return unit[:, None] * ((vectors / jnp.maximum(values, LEAST)) @ vectors.T) * unit


def hessian(gradient: Callable[[Array], Array], position: Float[Array, " dof"], reach: Float[Array, " dof"]) -> Float[Array, "dof dof"]:
    """Return minus the derivatives of a gradient, from its differences on both sides, made symmetric."""

    def row(number: Array) -> Array:
        step = jnp.zeros_like(position).at[number].set(reach[number])
        forward, backward = jax.lax.map(gradient, jnp.stack([position + step, position - step]))
        return -(forward - backward) / (2 * reach[number])

    rows = jax.lax.map(row, jnp.arange(position.shape[0]))
    return (rows + rows.T) / 2


def finite(matrix: Array) -> Array:
    """Return a matrix with 0 in place of what is not finite."""
    return jnp.where(jnp.isfinite(matrix), matrix, 0.0)


def offered(density: Density, sampled: State, previous: State) -> Float[Array, "dof dof"]:
    """Return the curvature that likelihoods supply, by the sampled variables in alphabetical order."""
    transition = density.transition
    by_variable = density.curvature(transition.state(previous, sampled), previous)
    total = jax.scipy.linalg.block_diag(*(by_variable[name] for name in sorted(sampled)))
    flat, unravel = ravel_pytree(dict(sampled))
    for name, value in transition.derive(sampled).items():
        jacobian = jax.jacfwd(lambda x, name=name: jnp.ravel(transition.derive(unravel(x))[name]))(flat)
        total += jacobian.T @ by_variable[name].reshape(value.size, value.size) @ jacobian
    return total


def _slopes_and_bends(coordinates: Coordinates, position: State) -> tuple[dict[str, Array], dict[str, Array]]:
    pairs = {name: _slope_and_bend(coordinates.bijections[name], x) for name, x in position.items()}
    return {name: slope for name, (slope, _) in pairs.items()}, {name: bend for name, (_, bend) in pairs.items()}


def _slope_and_bend(bijection: Transform, x: Array) -> tuple[Array, Array]:
    """Return ∂s/∂x of an entrywise bijection, and minus the second derivative of log |∂s/∂x| where that is positive."""
    ones = jnp.ones_like(x)

    def slope(x: Array) -> Array:
        return jax.jvp(bijection, (x,), (ones,))[1]

    def log_slope(x: Array) -> Array:
        # If the value equals a limit to the last bit, the slope is 0.
        return jnp.log(jnp.maximum(jnp.abs(slope(x)), jnp.finfo(x.dtype).tiny))

    def first(x: Array) -> Array:
        return jax.jvp(log_slope, (x,), (ones,))[1]

    return slope(x), jnp.maximum(-jax.jvp(first, (x,), (ones,))[1], 0.0)


def differenced(density: Density, sampled: State, previous: State, variances: Float[Array, " dof"]) -> Float[Array, "dof dof"]:
    """Return minus the second derivatives of the likelihoods without `curvature`, from gradients on both sides of the sampled variables."""
    flat, unravel = ravel_pytree(dict(sampled))
    names = density.without_curvature
    if not names:
        return jnp.zeros((flat.size, flat.size), flat.dtype)

    def gradient(values: Array) -> Array:
        return jax.grad(lambda v: density.log_likelihood_of(names, density.transition.state(previous, unravel(v)), previous))(values)

    return hessian(gradient, flat, DIFFERENCE * jnp.sqrt(variances))


def correlated(
    diagonal: Float[Array, " dof"], particles: Float[Array, "particle dof"], weights: Float[Array, " particle"]
) -> Float[Array, "dof dof"]:
    """Return a covariance with the scales of the diagonal and the correlations of weighted particles, in unconstrained coordinates."""
    weights = weights / jnp.sum(weights)
    centred = particles - weights @ particles
    covariance = (weights[:, None] * centred).T @ centred
    deviations = jnp.sqrt(jnp.diagonal(covariance))
    # Particles that are all equal, as before the first frame, have no correlations.
    spread = deviations > 1e-6 * jnp.sqrt(diagonal)
    safe = jnp.where(spread, deviations, 1.0)
    correlation = jnp.where(spread[:, None] & spread[None, :], covariance / (safe[:, None] * safe[None, :]), 0.0)
    off = ~jnp.eye(diagonal.shape[0], dtype=bool)
    scales = jnp.sqrt(diagonal)
    return jnp.where(off, SHRINKAGE * correlation, 1.0) * scales[:, None] * scales[None, :]
