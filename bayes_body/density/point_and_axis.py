r"""Rigid transforms with a roughly known point and axis: what a detector says about a part.

A point o of the part is near a place p in the world, and an axis a of the part is near a direction u. The rotation of the part about the axis is
unknown:

$$R o + t \sim \mathcal N(p, \operatorname{diag}(\sigma^2)), \qquad
p(R) = \frac{1}{8 \pi^2} \frac{\kappa}{\sinh \kappa} \exp(\kappa\, u \cdot R a).$$

The direction of the axis is von Mises-Fisher on the sphere (Mardia & Jupp 2000, 9.3.2). With a concentration κ of 0, nothing is known about the
rotation. The first density is normalised with respect to Lebesgue measure, the second with respect to Haar measure, under which all rotations have
the volume $8 \pi^2$.
"""

import math
from dataclasses import dataclass
from functools import partial

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from bayes_body.base.geometry import rigid, rotations
from bayes_body.base.shapes import Key, Scalar, Vector3
from bayes_body.density.tangent_normal import TangentNormal, log_normal, symmetric, tangent_normal

# Smaller concentrations are raised to this one, since the formulas divide by κ.
LEAST = 1e-3


@partial(jax.tree_util.register_dataclass, meta_fields=[], data_fields=["place", "point", "sd_m", "direction", "axis", "concentration"])
@dataclass(frozen=True)
class PointAndAxis:
    """The distribution of a rigid transform `X_world_part`.

    Attributes:
        place: where the point is, metres in the world.
        point: the point, metres in the part's frame.
        sd_m: standard deviations of the place along the world's axes, metres.
        direction: the direction of the axis in the world, of length 1.
        axis: the axis in the part's frame, of length 1.
        concentration: κ. If it is large, the direction has a standard deviation of 1 / sqrt(κ) radians about each normal.
    """

    place: Vector3
    point: Vector3
    sd_m: Vector3
    direction: Vector3
    axis: Vector3
    concentration: Scalar

    def sample(self, key: Key) -> Float[Array, "7"]:
        """Draw a transform."""
        place_key, along_key, around_key, turn_key = jax.random.split(key, 4)
        kappa = jnp.maximum(self.concentration, LEAST)
        u = jax.random.uniform(along_key, (), self.place.dtype, 1e-7, 1.0)
        cosine = jnp.clip(1 + jnp.log(u + (1 - u) * jnp.exp(-2 * kappa)) / kappa, -1.0, 1.0)
        perpendicular = jax.random.normal(around_key, (3,), self.place.dtype)
        perpendicular = _unit(perpendicular - jnp.dot(perpendicular, self.direction) * self.direction)
        aim = cosine * self.direction + jnp.sqrt(1 - cosine**2) * perpendicular
        # A uniform rotation, followed by the shortest one that brings the axis to its direction. The rotation about the axis stays uniform.
        anyhow = _unit(jax.random.normal(turn_key, (4,), self.place.dtype))
        quaternion = rotations.multiply(_shortest(jnp.asarray(rotations.rotate(anyhow, self.axis)), aim), anyhow)
        place = self.place + self.sd_m * jax.random.normal(place_key, (3,), self.place.dtype)
        return jnp.asarray(rigid.rigid(place - rotations.rotate(quaternion, self.point), quaternion))

    def log_prob(self, x: Float[Array, "7"]) -> Scalar:
        """Return the log-density with respect to dt dR."""
        offset = (rigid.apply(x, self.point) - self.place) / self.sd_m
        normal = -0.5 * jnp.sum(offset**2) - jnp.sum(jnp.log(self.sd_m)) - 1.5 * math.log(2 * math.pi)
        kappa = jnp.maximum(self.concentration, LEAST)
        cosine = jnp.dot(self.direction, rotations.rotate(rigid.quaternion(x), self.axis))
        # κ / sinh κ = 2 κ e^-κ / (1 - e^-2κ)
        of_axis = kappa * (cosine - 1) + jnp.log(2 * kappa) - jnp.log(-jnp.expm1(-2 * kappa))
        return normal + of_axis - math.log(8 * math.pi**2)

    def combine(self, prediction: TangentNormal) -> tuple[TangentNormal, Scalar]:
        """Return a prediction of the transform given that its point is at the place, and the log-density of that; both to first order.

        The axis is not read: use it where the direction is unknown.
        """
        x = prediction.mean
        miss = self.place - rigid.apply(x, self.point)
        # A small rotation vector w in the part's frame moves the point by R (w × o).
        levers = jnp.stack([rotations.rotate(rigid.quaternion(x), jnp.cross(unit, self.point)) for unit in jnp.eye(3, dtype=x.dtype)], axis=1)
        slope = jnp.concatenate([jnp.eye(3, dtype=x.dtype), levers], axis=1)
        covariance = prediction.root @ prediction.root.T
        total = slope @ covariance @ slope.T + jnp.diag(self.sd_m**2)
        gain = jnp.linalg.solve(total, slope @ covariance).T
        mean = jnp.asarray(prediction.space.retract(x, gain @ miss))
        return tangent_normal(prediction.space, mean, symmetric(covariance - gain @ slope @ covariance)), log_normal(miss, total)


def _unit(v: Array) -> Array:
    return v / jnp.maximum(jnp.linalg.norm(v), 1e-12)


def _shortest(v: Vector3, to: Vector3) -> Float[Array, "4"]:
    """Return the quaternion of the shortest rotation that brings one unit vector to another one."""
    return _unit(jnp.concatenate([1 + jnp.dot(v, to)[None], jnp.cross(v, to)]))
