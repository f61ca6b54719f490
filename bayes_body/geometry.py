"""Rotations and rigid transforms, written as elementwise sums.

A 3×3 product through `dot_general` inside `vmap` costs XLA on a CPU several times what the same sums cost elementwise; every pose of every
particle passes here, so rotations are kept as three columns and turned by elementary rotations, which touch two columns only.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from bayes_body.shapes import Rotation, Scalar, Vector3


class Transform(NamedTuple):
    """A rigid transform `T_a_b`: takes coordinates in frame b to frame a. Columns `x`, `y`, `z` are b's axes seen from a."""

    x: Vector3
    y: Vector3
    z: Vector3
    origin: Vector3


def identity(dtype: jnp.dtype) -> Transform:
    """The transform that changes nothing."""
    x, y, z = jnp.eye(3, dtype=dtype)
    return Transform(x, y, z, jnp.zeros(3, dtype))


def apply(T_a_b: Transform, p_b: Vector3) -> Vector3:
    """The point `p_b`, metres in frame b, in frame a."""
    return T_a_b.origin + direction(T_a_b, p_b)


def direction(T_a_b: Transform, v_b: Vector3) -> Vector3:
    """The vector `v_b` of frame b in frame a."""
    return T_a_b.x * v_b[0] + T_a_b.y * v_b[1] + T_a_b.z * v_b[2]


def compose(T_a_b: Transform, rotation_b_c: Rotation, p_b_c: Vector3) -> Transform:
    """`T_a_c` from `T_a_b` and a fixed rotation and origin of c in b."""
    x, y, z = (direction(T_a_b, rotation_b_c[:, i]) for i in range(3))
    return Transform(x, y, z, apply(T_a_b, p_b_c))


def turn(T: Transform, axis: int, cos: Scalar, sin: Scalar) -> Transform:
    """`T` followed by a right-handed rotation about its own axis 0 (x), 1 (y) or 2 (z)."""
    columns = [T.x, T.y, T.z]
    i, j = (axis + 1) % 3, (axis + 2) % 3
    a, b = columns[i], columns[j]
    columns[i], columns[j] = cos * a + sin * b, cos * b - sin * a
    x, y, z = columns
    return Transform(x, y, z, T.origin)


def shift(T: Transform, axis: int, distance: Scalar) -> Transform:
    """`T` followed by a translation along its own axis 0 (x), 1 (y) or 2 (z), in metres."""
    return T._replace(origin=T.origin + T[axis] * distance)


def matrix(T: Transform) -> Float[Array, "4 4"]:
    """The homogeneous matrix of a transform."""
    columns = jnp.stack([T.x, T.y, T.z, T.origin], axis=1)
    return jnp.concatenate([columns, jnp.array([[0, 0, 0, 1]], columns.dtype)])


def dot(a: Float[Array, "*batch 3"], b: Float[Array, "*batch 3"]) -> Float[Array, "*batch"]:
    """The scalar product over the last axis, elementwise."""
    return a[..., 0] * b[..., 0] + a[..., 1] * b[..., 1] + a[..., 2] * b[..., 2]


def unit(v: Float[Array, "*batch 3"], tiny: float = 1e-12) -> Float[Array, "*batch 3"]:
    """`v` scaled to length one; a null vector stays null, with a finite gradient."""
    # rsqrt of a clamped square, not a `where` around sqrt: reverse mode differentiates both branches, and sqrt'(0) is infinite.
    return v * jax.lax.rsqrt(jnp.maximum(dot(v, v), tiny))[..., None]
