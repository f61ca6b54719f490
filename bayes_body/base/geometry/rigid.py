"""Rigid transforms as 7-vectors (x, y, z, qw, qx, qy, qz): metres and a unit quaternion. `X_a_b` maps coordinates in frame b to frame a.

This is the form in which the placed parts of a body are stored, sampled and exported. `geometry.transforms` has the same transforms as matrices, in
which points are moved faster.
"""

from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from bayes_body.base.geometry import rotations
from bayes_body.base.geometry.namespaces import joined
from bayes_body.base.geometry.rotations import Quaternion, Vector
from bayes_body.base.geometry.transforms import Transform

type Rigid = Float[Array | np.ndarray, "*#batch 7"]

NAMES = ("x", "y", "z", "qw", "qx", "qy", "qz")


def identity(dtype: Any = float) -> Float[np.ndarray, "7"]:
    """Return the transform that moves nothing."""
    return np.array([0, 0, 0, 1, 0, 0, 0], dtype)


def rigid(translation: Vector, quaternion: Quaternion) -> Rigid:
    """Return the 7-vector of a translation (b's origin in frame a, metres) and a unit quaternion `q_a_b`."""
    return joined(translation, quaternion)


def translation(X: Rigid) -> Vector:
    """Return b's origin in frame a, metres."""
    return X[..., :3]


def quaternion(X: Rigid) -> Quaternion:
    """Return the rotation `q_a_b`."""
    return X[..., 3:]


def apply(X_a_b: Rigid, p_b: Vector) -> Vector:
    """Map the points `p_b`, metres in frame b, to frame a."""
    return translation(X_a_b) + rotations.rotate(quaternion(X_a_b), p_b)


def compose(X_a_b: Rigid, X_b_c: Rigid) -> Rigid:
    """Return `X_a_c`."""
    return rigid(apply(X_a_b, translation(X_b_c)), rotations.multiply(quaternion(X_a_b), quaternion(X_b_c)))


def inverse(X_a_b: Rigid) -> Rigid:
    """Return `X_b_a`."""
    q_b_a = rotations.conjugate(quaternion(X_a_b))
    return rigid(-rotations.rotate(q_b_a, translation(X_a_b)), q_b_a)


def relative(X_a_b: Rigid, X_a_c: Rigid) -> Rigid:
    """Return `X_b_c`, the second transform as seen from the first."""
    q_b_a = rotations.conjugate(quaternion(X_a_b))
    offset = translation(X_a_c) - translation(X_a_b)
    return rigid(rotations.rotate(q_b_a, offset), rotations.multiply(q_b_a, quaternion(X_a_c)))


def to_transform(X: Float[Array, "*batch 7"]) -> Transform:
    """Return the transforms as matrices."""
    return Transform(jnp.asarray(rotations.to_matrix(quaternion(X))), X[..., :3])


def from_transform(T: Transform) -> Float[Array, "*batch 7"]:
    """Return the transforms as 7-vectors, with the quaternion's sign of `rotations.canonical`."""
    return jnp.concatenate([T.origin, jnp.asarray(rotations.from_matrix(T.rotation))], axis=-1)
