r"""A pinhole camera with Bouguet's (OpenCV's) distortion, and the radius at which its lens folds the picture.

$x = X/Z,\ y = Y/Z,\ r^2 = x^2 + y^2$ in the camera's frame; $x_d = x (1 + k_1 r^2 + k_2 r^4 + k_3 r^6) + 2 p_1 x y + p_2 (r^2 + 2 x^2)$ and likewise
$y_d$; $u = f_x (x_d + \alpha y_d) + c_x,\ v = f_y y_d + c_y$, pixels, the first pixel's centre at (0, 0).

With $r$ the distance from the optical axis at unit depth, the lens maps $r$ to $r (1 + k_1 r^2 + k_2 r^4 + k_3 r^6)$. Where this stops growing, at
`radius_max`, the picture folds back: points further out, even far outside the field of view, would land on those further in. Points beyond this
radius, or behind the camera, are not visible.
"""

import math
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float
from numpy.typing import NDArray

from bayes_body.base.geometry.namespaces import device_array
from bayes_body.base.shapes import Rotation, Scalar, Vector3

# No lens has coefficients like this; their powers would overflow.
LARGEST_COEFFICIENT = 1e9


def folding_radius(k1: float, k2: float, k3: float) -> float:
    """Return the smallest $r$ at which the distortion stops growing; infinite if it never does, 0 for coefficients of no lens."""
    # The derivative's roots in 1 / r^2: a leading coefficient of 1 needs no division, which could overflow.
    derivative = np.array([1.0, 3 * k1, 5 * k2, 7 * k3])
    if not (np.abs(derivative) <= LARGEST_COEFFICIENT).all():
        return 0.0
    roots = np.roots(derivative)
    real = roots[(np.abs(roots.imag) <= 1e-9 * np.abs(roots)) & (roots.real > 0)].real
    return float(1 / np.sqrt(real.max())) if real.size else math.inf


# A point nearer to the camera's plane than this (metres) counts as behind it, so the division stays finite.
NEAR = 0.05


@partial(
    jax.tree_util.register_dataclass,
    meta_fields=[],
    data_fields=["rotation", "translation", "focal", "centre", "skew", "distortion", "radius_max", "size"],
)
@dataclass(frozen=True)
class Camera:
    """One camera: `X_camera = rotation @ X_world + translation` (metres), intrinsics in pixels, `size` = (width, height).

    A rig is a Camera whose leaves have a leading camera axis. The functions here take one camera and are vmapped over a rig.
    """

    rotation: Rotation
    translation: Vector3
    focal: Float[Array, "2"]
    centre: Float[Array, "2"]
    skew: Scalar
    distortion: Float[Array, "5"]
    radius_max: Scalar
    size: Float[Array, "2"]

    @property
    def viewpoint(self) -> Vector3:
        """The camera's centre in the world, metres."""
        return -jnp.sum(self.rotation * self.translation[:, None], axis=0)


class Pixels[T](NamedTuple):
    """Projected points: column `u`, row `v`, and whether the point is visible (in front of the camera, and not past the lens's turning point)."""

    u: T
    v: T
    visible: T


def to_camera(camera: Camera, vector: Float[Array, "*batch 3"]) -> Float[Array, "*batch 3"]:
    """A direction of the world, expressed in the camera's frame."""
    X, Y, Z = jnp.split(vector, 3, axis=-1)
    along_x, along_y, along_z = camera.rotation.T
    return X * along_x + Y * along_y + Z * along_z


def project_components(camera: Camera, X: Array, Y: Array, Z: Array) -> Pixels[Array]:
    """Project points given by their components in the camera's frame (metres, any equal shapes)."""
    x, y, in_front = _divided(X, Y, Z)
    k1, k2, p1, p2, k3 = camera.distortion
    r2 = x * x + y * y
    radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    xy2 = 2 * x * y
    xd = x * radial + p1 * xy2 + p2 * (r2 + 2 * x * x)
    yd = y * radial + p2 * xy2 + p1 * (r2 + 2 * y * y)
    u = camera.focal[0] * (xd + camera.skew * yd) + camera.centre[0]
    v = camera.focal[1] * yd + camera.centre[1]
    return Pixels(u, v, in_front & (r2 < camera.radius_max**2))


def in_view(camera: Camera, X: Array, Y: Array, Z: Array) -> Bool[Array, "..."]:
    """Only `Pixels.visible`: whether points are visible, from their components in the camera's frame (metres, any equal shapes)."""
    x, y, in_front = _divided(X, Y, Z)
    return in_front & (x * x + y * y < camera.radius_max**2)


def _divided(X: Array, Y: Array, Z: Array) -> tuple[Array, Array, Array]:
    """X / Z and Y / Z, and whether a point is in front of the camera."""
    in_front = Z > NEAR
    # `where` before the division: a point behind the camera must not get an infinite gradient.
    inverse = 1 / jnp.where(in_front, Z, 1.0)
    return X * inverse, Y * inverse, in_front


def project(camera: Camera, points: Float[Array, "*batch 3"]) -> tuple[Float[Array, "*batch 2"], Bool[Array, "*batch"]]:
    """Pixel coordinates (column, row) of world points (metres), and whether each is visible. Visible points agree with `cv2.projectPoints`."""
    p = to_camera(camera, points) + camera.translation
    pixels = project_components(camera, p[..., 0], p[..., 1], p[..., 2])
    return jnp.stack([pixels.u, pixels.v], axis=-1), pixels.visible


def turning_radius(distortion: NDArray[np.floating], limit: float = 1e3) -> float:
    """The distance from the optical axis at unit depth at which the lens folds its picture (`folding_radius`); `limit` if that is further out."""
    k1, k2, _, _, k3 = np.asarray(distortion, float)
    return min(folding_radius(k1, k2, k3), limit)


def stack(cameras: list[Camera]) -> Camera:
    """Stack the cameras' leaves along a leading camera axis, which makes a rig."""
    return jax.tree.map(lambda *leaves: device_array(np.stack(leaves), leaves[0].dtype), *cameras)
