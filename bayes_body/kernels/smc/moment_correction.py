r"""Correct the mean and the covariance of weighted draws by the slope of the log-density from which they come.

For a smooth density π without walls, the slope $s = \nabla \log \pi$ has known expectations (Stein's identity):

$$E[s] = 0, \qquad E[s\, (u - \mu)^T] = -I.$$

Where the draws give other values, their moments are wrong too, and the slopes tell by how much (zero-variance control variates: Assaraf & Caffarel
1999; Mira, Solgi & Imparato 2013). Take coordinates z in which the draws have mean 0 and covariance I, and in which the residuals of a linear fit of
s to z have a diagonal covariance, with entries $\epsilon_j$. In these coordinates the mean is estimated as $\Lambda^{-1} m$ and the covariance as
$\Lambda^{-1}$, with

$$m_j = \frac{\bar s_j}{1 + \epsilon_j}, \qquad
\Lambda_{jk} = \delta_{jk} - a_{jk} H_{jk} - a_{kj} H_{kj}, \quad H = \overline{s z^T} + I, \quad
a_{jk} = \frac{1 / \epsilon_j}{1 + 1 / \epsilon_j + 1 / \epsilon_k}.$$

The factors give the least variance if z is Gaussian and independent of the residuals. If π is Gaussian, there are no residuals, and both moments are
exact for any draws. In a direction in which the likelihood says nothing, they are the moments of the prior. Without the correction, a filter's mean
would take a random step in such a direction in every frame.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from bayes_body.base.shapes import Key
from bayes_body.kernels.weights import LogWeights

# Limits of the factor by which a variance is corrected.
FACTORS = (0.25, 4.0)
# Added to the variances, relative, so that the covariance has a root in float32.
FLOOR = 1e-5


class Moments(NamedTuple):
    """A mean, and a root of a covariance."""

    mean: Float[Array, " dof"]
    root: Float[Array, "dof dof"]


def corrected_moments(draws: Float[Array, "draw dof"], log_weights: LogWeights, slopes: Float[Array, "draw dof"]) -> Moments:
    """Return the corrected moments of weighted draws.

    Args:
        draws: in coordinates without limits.
        log_weights: their log-weights.
        slopes: the gradient of the log-density at each draw.
    """
    weights = jax.nn.softmax(log_weights)
    identity = jnp.eye(draws.shape[1], dtype=draws.dtype)
    mean, root = moments(draws, log_weights)
    white, steep = _whitened(draws - mean, root), slopes @ root
    slope = (weights[:, None] * steep).T @ white
    remainder = steep - weights @ steep - white @ slope.T
    epsilon, axes = jnp.linalg.eigh((weights[:, None] * remainder).T @ remainder)
    epsilon, excess = jnp.maximum(epsilon, 1e-6), axes.T @ slope @ axes + identity
    trust = 1 / epsilon
    part = trust[:, None] / (1 + trust[:, None] + trust[None, :]) * excess
    precisions, directions = jnp.linalg.eigh(identity - part - part.T)
    precisions = jnp.clip(precisions, *FACTORS)
    shift = ((weights @ steep @ axes / (1 + epsilon)) @ directions / precisions) @ directions.T
    covariance = (directions / precisions) @ directions.T
    rotated_root = root @ axes
    return Moments(mean + rotated_root @ shift, _root(rotated_root @ covariance @ rotated_root.T))


def moments(draws: Float[Array, "draw dof"], log_weights: LogWeights) -> Moments:
    """Return the moments of weighted draws."""
    weights = jax.nn.softmax(log_weights)
    mean = weights @ draws
    centred = draws - mean
    return Moments(mean, _root((weights[:, None] * centred).T @ centred))


def with_moments(draws: Float[Array, "draw dof"], log_weights: LogWeights, wanted: Moments) -> Float[Array, "draw dof"]:
    """Return weighted draws moved and stretched to the moments `wanted`; unchanged if these are not finite."""
    current = moments(draws, log_weights)
    moved = wanted.mean + _whitened(draws - current.mean, current.root) @ wanted.root.T
    return jnp.where(jnp.all(jnp.isfinite(moved)), moved, draws)


def noise_beside(key: Key, draws: Float[Array, "draw dof"], log_weights: LogWeights, size: int) -> Float[Array, "draw {size}"]:
    """Return standard normal noise whose weighted mean is 0, whose covariance is I, and which is not correlated with the draws.

    Independent noise would move the mean by chance. The noise is for variables that no image pulls back, such as velocities, so these steps would add
    up over the frames. With too few draws for these moments, the noise is independent.

    Args:
        key: random key.
        draws: in coordinates without limits.
        log_weights: their log-weights.
        size: number of entries of the noise for each draw.
    """
    noise = jax.random.normal(key, (draws.shape[0], size), draws.dtype)
    if draws.shape[0] < 2 * (draws.shape[1] + size + 1) or not size:
        return noise
    weights = jax.nn.softmax(log_weights)
    current = moments(draws, log_weights)
    white, centred = _whitened(draws - current.mean, current.root), noise - weights @ noise
    residual = centred - white @ ((weights[:, None] * white).T @ centred)
    exact = with_moments(residual, log_weights, Moments(jnp.zeros(size, draws.dtype), jnp.eye(size, dtype=draws.dtype)))
    return jnp.where(jnp.all(jnp.isfinite(exact)), exact, noise)


def _whitened(centred: Float[Array, "draw dof"], root: Float[Array, "dof dof"]) -> Float[Array, "draw dof"]:
    return jax.scipy.linalg.solve_triangular(root, centred.T, lower=True).T


def _root(covariance: Float[Array, "dof dof"]) -> Float[Array, "dof dof"]:
    return jnp.linalg.cholesky(covariance + FLOOR * jnp.diag(jnp.diagonal(covariance)))
