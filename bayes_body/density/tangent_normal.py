r"""A normal distribution around a point of any space: a tangent vector is drawn, and the space maps it to a point.

With $v \sim \mathcal N(0, \Sigma)$ at the mean $\mu$, the density at x with respect to the space's reference measure is a sum over the tangent
vectors $v_k$ that lead from μ to x, $\sum_k \mathcal N(v_k; 0, \Sigma) / J(v_k)$. For an angle or a rotation, these vectors differ by full turns. So
the density is that of a wrapped normal, and no draw is discarded. Only the nearest turns are summed (`Space.images`).
"""

import math
from dataclasses import dataclass
from functools import partial

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from bayes_body.base.shapes import Key, Scalar
from bayes_body.density.spaces import Space

# Largest standard deviation of a fit, radians. With a larger one, the turns that are not summed would matter.
WIDEST_RAD = 1.2
# Smallest standard deviation of a fit, as a share of the unweighted one, so that one heavy point does not end the search.
NARROWEST = 0.02
# Added to every standard deviation: points may all be equal.
TINY = 1e-6


@partial(jax.tree_util.register_dataclass, meta_fields=["space"], data_fields=["mean", "root", "inverse"])
@dataclass(frozen=True)
class TangentNormal:
    """A normal distribution around a point of a space.

    Attributes:
        space: the space.
        mean: the mean, a point.
        root: lower triangular root of the covariance of the tangent vectors.
        inverse: the inverse of the root.
    """

    space: Space
    mean: Array
    root: Float[Array, "dimension dimension"]
    inverse: Float[Array, "dimension dimension"]

    def sample(self, key: Key) -> Array:
        """Draw a point."""
        return jnp.asarray(self.space.retract(self.mean, self.root @ jax.random.normal(key, self.root.shape[:1], self.root.dtype)))

    def log_prob(self, x: Array) -> Scalar:
        """Return the log-density at a point, with respect to the space's reference measure."""
        v = jnp.asarray(self.space.images(self.space.local(self.mean, x)))
        normal = -0.5 * jnp.sum((v @ self.inverse.T) ** 2, axis=1) + jnp.sum(jnp.log(jnp.diagonal(self.inverse)))
        log_densities = normal - jnp.asarray(self.space.log_measure(v)) - 0.5 * v.shape[-1] * math.log(2 * math.pi)
        return log_densities[0] if log_densities.shape == (1,) else jax.nn.logsumexp(log_densities)

    def combine(self, prediction: "TangentNormal") -> "tuple[TangentNormal, Scalar]":
        """Return the product with a prediction of the same value, normalised, and the log of its integral; both to first order.

        What this distribution leaves open, such as the turn of a limb about its axis, then follows the prediction.
        """
        offset = jnp.asarray(self.space.local(self.mean, prediction.mean))
        covariance = self.root @ self.root.T
        total = covariance + prediction.root @ prediction.root.T
        gain = jnp.linalg.solve(total, covariance).T
        mean = jnp.asarray(self.space.retract(self.mean, gain @ offset))
        return tangent_normal(self.space, mean, symmetric(covariance - gain @ covariance)), log_normal(offset, total)


def log_normal(v: Float[Array, " dimension"], covariance: Float[Array, "dimension dimension"]) -> Scalar:
    """Return the log-density of a normal distribution with mean zero."""
    return -0.5 * (v @ jnp.linalg.solve(covariance, v) + jnp.linalg.slogdet(covariance)[1] + len(v) * math.log(2 * math.pi))


def symmetric(covariance: Float[Array, "dimension dimension"]) -> Float[Array, "dimension dimension"]:
    """Return a covariance that is the difference of two others without the traces of rounding, which could make it no covariance."""
    return (covariance + covariance.T) / 2 + TINY**2 * jnp.eye(len(covariance), dtype=covariance.dtype)


def tangent_normal(space: Space, mean: Array, covariance: Float[Array, "dimension dimension"]) -> TangentNormal:
    """Return the distribution with this mean and covariance of tangent vectors."""
    root = jnp.linalg.cholesky(covariance)
    return TangentNormal(space, mean, root, jax.scipy.linalg.solve_triangular(root, jnp.eye(len(root), dtype=root.dtype), lower=True))


def fit(space: Space, weights: Float[Array, " point"], points: Array, inflation: float = 1.0, floors: Array | float = 0.0) -> TangentNormal:
    """Return the normal distribution with the weighted mean and covariance of points.

    Args:
        space: the space of a point.
        weights: weights, normalised.
        points: points, with a leading axis.
        inflation: factor of the covariance.
        floors: smallest standard deviation of each tangent coordinate.
    """
    mean = jnp.asarray(space.mean(weights, points))
    v = jnp.asarray(space.local(mean[None], points))
    covariance = inflation * (v * weights[:, None]).T @ v
    return tangent_normal(space, mean, widened(space, covariance, least_sds(v, floors)))


def least_sds(v: Float[Array, "point dimension"], floors: Array | float) -> Float[Array, " dimension"]:
    """Return the smallest standard deviations of a fit to points with these tangent vectors, whatever their weights."""
    return jnp.maximum(jnp.asarray(floors, v.dtype), NARROWEST * jnp.std(v, axis=0) + TINY)


def widened(space: Space, covariance: Float[Array, "dimension dimension"], least: Float[Array, " dimension"]) -> Float[Array, "dimension dimension"]:
    """Return a covariance with variances of at least `least` squared, and not so wide that angles would wind around the circle."""
    covariance = covariance + jnp.diag(least**2)
    angles = jnp.asarray([unit == "rad" for unit in space.tangent_units])
    sd = jnp.sqrt(jnp.diagonal(covariance))
    shrink = jnp.where(angles, jnp.minimum(1.0, WIDEST_RAD / sd), 1.0)
    return covariance * shrink[:, None] * shrink[None]
