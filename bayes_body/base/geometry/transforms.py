"""Rotations and rigid transforms, batched, written as elementwise sums.

Inside `vmap`, XLA's `dot_general` makes a 3×3 product several times slower on a CPU than the same sums elementwise, and every pose of every particle
uses these functions.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int


class Transform(NamedTuple):
    """Rigid transforms `T_a_b`, which map coordinates in frame b to frame a.

    Attributes:
        rotation: its columns `x`, `y`, `z` are b's axes in frame a.
        origin: b's origin in frame a, metres.
    """

    rotation: Float[Array, "*batch 3 3"]
    origin: Float[Array, "*batch 3"]

    @property
    def x(self) -> Float[Array, "*batch 3"]:
        """The first axis of b."""
        return self.rotation[..., 0]

    @property
    def y(self) -> Float[Array, "*batch 3"]:
        """The second axis of b."""
        return self.rotation[..., 1]

    @property
    def z(self) -> Float[Array, "*batch 3"]:
        """The third axis of b."""
        return self.rotation[..., 2]


def apply(T_a_b: Transform, p_b: Float[Array, "*batch 3"]) -> Float[Array, "*batch 3"]:
    """Map the points `p_b`, metres in frame b, to frame a."""
    return T_a_b.origin + turn(T_a_b.rotation, p_b)


def turn(R_a_b: Float[Array, "*batch 3 3"], v_b: Float[Array, "*batch 3"]) -> Float[Array, "*batch 3"]:
    """Rotate the vectors `v_b` from frame b to frame a."""
    return R_a_b[..., 0] * v_b[..., :1] + R_a_b[..., 1] * v_b[..., 1:2] + R_a_b[..., 2] * v_b[..., 2:]


def multiply(R_a_b: Float[Array, "*batch 3 3"], R_b_c: Float[Array, "*batch 3 3"]) -> Float[Array, "*batch 3 3"]:
    """`R_a_c`."""
    return R_a_b[..., :1] * R_b_c[..., :1, :] + R_a_b[..., 1:2] * R_b_c[..., 1:2, :] + R_a_b[..., 2:] * R_b_c[..., 2:, :]


def compose(T_a_b: Transform, T_b_c: Transform) -> Transform:
    """`T_a_c`."""
    return Transform(multiply(T_a_b.rotation, T_b_c.rotation), apply(T_a_b, T_b_c.origin))


def pick(T: Transform, index: int | Int[np.ndarray, " picked"]) -> Transform:
    """Select one or several transforms from a stack."""
    return Transform(T.rotation[index], T.origin[index])


def matrix(T: Transform) -> Float[Array, "*batch 4 4"]:
    """The transforms as homogeneous matrices."""
    columns = jnp.concatenate([T.rotation, T.origin[..., None]], axis=-1)
    last = jnp.broadcast_to(jnp.array([0, 0, 0, 1], columns.dtype), (*columns.shape[:-2], 1, 4))
    return jnp.concatenate([columns, last], axis=-2)


def dot(a: Float[Array, "*batch 3"], b: Float[Array, "*batch 3"]) -> Float[Array, "*batch"]:
    """The scalar product over the last axis, elementwise."""
    return a[..., 0] * b[..., 0] + a[..., 1] * b[..., 1] + a[..., 2] * b[..., 2]


def unit(v: Float[Array, "*batch 3"], tiny: float = 1e-12) -> Float[Array, "*batch 3"]:
    """`v` scaled to length one; a zero vector stays zero, with a finite gradient."""
    # rsqrt of a clamped square instead of a `where` around sqrt: reverse mode differentiates both branches, and sqrt'(0) is infinite.
    return v * jax.lax.rsqrt(jnp.maximum(dot(v, v), tiny))[..., None]
