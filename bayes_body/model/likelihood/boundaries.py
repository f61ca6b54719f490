r"""Points on the occluding boundaries of a body's parts in each camera: their position and direction, and whether another part hides them.

Samples are at fixed places of the contour $e \pm r (a \times c)/\|a \times c\|$ (Poon & Fleet 2002, 3.2; model/body/solids.py), so they move smoothly
with the pose. A part hides a sample if the sample lies inside the part's outline, and the part's axis is nearer to the camera there. Parts are
convex; their outlines are quadrilaterals and ellipses. With hard visibility a sample is hidden or not, so a density built on it has jumps. With soft
visibility it is hidden to the fraction

$$\sigma(d / h_d)\ \sigma((Z - Z' - m) / h_Z)$$

where d is its distance inside the outline, Z its depth, Z' the depth of the axis, and m the margin.
"""

from typing import Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from bayes_body.base.geometry.camera import Camera, Pixels
from bayes_body.model.body.solids import Body, Samples, outline_samples
from bayes_body.model.likelihood.outlines import forms_of
from bayes_body.model.likelihood.patch_pixels import by_component, corner_pixels, sample_pixels

type Visibility = Literal["hard", "soft"]
type Grid = Float[Array, "camera part sample"]
type RigPatches = Float[Array, "camera 4 part 3"]

# For soft visibility: the width of an outline's edge, pixels, and of the depth comparison, metres.
SOFT_PX, SOFT_M = 1.5, 0.02
# How much nearer an axis must be. Neighbours along a limb meet at the joint and must not hide each other.
MARGIN_M = 0.03


class Contour(NamedTuple):
    """Samples of every part's contour: coefficients (t, s), and their derivatives along the contour."""

    samples: Samples
    tangents: Samples


class Boundaries(NamedTuple):
    """The samples in a rig's images: pixels, unit normals, and the visible fraction of each, in [0, 1]."""

    pixels: Pixels[Grid]
    normals: tuple[Grid, Grid]
    visible: Grid


def contour(body: Body, per_side: int) -> Contour:
    """`per_side` samples on both sides of every part."""
    samples = outline_samples(body, per_side)
    t, s = (np.asarray(axis) for axis in samples)
    sphere = np.array(body.topology.is_sphere)[:, None]
    # For a circle t = (1 + sin α) / 2, s = ± cos α.
    along_t = np.where(sphere, np.sqrt(np.maximum(t * (1 - t), 0)), 1.0)
    along_s = np.where(sphere, -np.sign(s) * (2 * t - 1), 0.0)
    dtype = body.lengths.dtype
    return Contour(samples, Samples(jnp.asarray(along_t, dtype), jnp.asarray(along_s, dtype)))


def boundaries(body: Body, rig: Camera, contour: Contour, in_camera: RigPatches, visibility: Visibility) -> Boundaries:
    """Project the samples of the parts' patches, which are given in each camera's frame (`patch_pixels.rig_patches`)."""
    pixels = sample_pixels(rig, in_camera, contour.samples)
    depths, normals = jax.vmap(_direction, (0, 0, None))(rig, in_camera, contour)
    shown = _share(_inside_image(rig, pixels), SOFT_PX, visibility) * _shown(body, rig, in_camera, pixels, depths, visibility)
    return Boundaries(pixels, normals, jnp.where(pixels.visible, shown, 0.0))


def _direction(camera: Camera, in_camera: Float[Array, "4 part 3"], contour: Contour) -> tuple[Float[Array, "part sample"], tuple[Array, Array]]:
    """Depth of each sample, metres, and the unit normal of its contour in the image. The effect of the lens's distortion on it is negligible."""
    (t, s), (dt, ds), patches = contour.samples, contour.tangents, by_component(in_camera)
    X, Y, Z = (p.start + p.axis * t + p.half_width * s + p.taper * (t * s) for p in patches)
    to_x, to_y, to_z = (dt * (p.axis + s * p.taper) + ds * (p.half_width + t * p.taper) for p in patches)
    # The contour's direction in the image, up to a factor.
    du = camera.focal[0] * ((to_x * Z - X * to_z) + camera.skew * (to_y * Z - Y * to_z))
    dv = camera.focal[1] * (to_y * Z - Y * to_z)
    # A side seen exactly end-on is a point: any direction will do, as long as it is finite.
    scale = jax.lax.rsqrt(du * du + dv * dv + (1e-6 * camera.focal[0]) ** 2)
    return Z, (-dv * scale, du * scale)


def _inside_image(rig: Camera, pixels: Pixels[Grid]) -> Grid:
    """How far inside the image a sample is, pixels."""
    width, height = (rig.size[:, k, None, None] for k in (0, 1))
    return jnp.minimum(jnp.minimum(pixels.u, width - 1 - pixels.u), jnp.minimum(pixels.v, height - 1 - pixels.v))


def _share(value: Array, width: float, visibility: Visibility) -> Array:
    """1 where the value is above 0, else 0; with soft visibility a ramp of that width."""
    return (value > 0).astype(value.dtype) if visibility == "hard" else jax.nn.sigmoid(value / width)


def _shown(body: Body, rig: Camera, in_camera: RigPatches, pixels: Pixels[Grid], depths: Grid, visibility: Visibility) -> Grid:
    """Return the fraction of each sample that no other part hides."""
    cameras, parts, samples = depths.shape
    forms = forms_of(body.topology, rig, in_camera)
    ends = corner_pixels(rig, in_camera, np.repeat([[0.0], [1.0]], parts, axis=1).astype(in_camera.dtype), np.zeros((2, parts), in_camera.dtype))
    middles = [rig.size[:, k, None, None] / 2 for k in (0, 1)]
    columns, rows = ((x - middle).reshape(cameras, -1) for x, middle in zip((pixels.u, pixels.v), middles, strict=True))
    inside = jax.vmap(_insides)(forms, columns, rows)
    nearer = depths.reshape(cameras, 1, -1) - _axis_depths(in_camera, (ends.u - middles[0], ends.v - middles[1]), columns, rows)
    covers = _share(inside, SOFT_PX, visibility) * _share(nearer - MARGIN_M, SOFT_M, visibility)
    is_other = jnp.asarray(1 - np.repeat(np.eye(parts), samples, axis=1), depths.dtype)
    return jnp.prod(1 - covers * is_other, axis=1).reshape(depths.shape)


def _insides(forms: Float[Array, "coefficient 4 part"], columns: Float[Array, " point"], rows: Float[Array, " point"]) -> Float[Array, "part point"]:
    """How far points are inside each part's outline, pixels (model/likelihood/outlines.py). All four forms of a sphere are the same."""
    basis = [jnp.ones_like(columns), columns, rows, columns * columns, columns * rows, rows * rows][: forms.shape[0]]
    sides = sum(form[:, :, None] * monomial for form, monomial in zip(forms, basis, strict=True))
    return jnp.min(sides, axis=0)


def _axis_depths(
    in_camera: RigPatches, ends: tuple[Array, Array], columns: Float[Array, "camera point"], rows: Array
) -> Float[Array, "camera part point"]:
    """The depth of each part's axis where it is nearest to a point in the image, metres."""
    (u0, u1), (v0, v1) = ((x[:, 0, :, None], x[:, 1, :, None]) for x in ends)
    du, dv = u1 - u0, v1 - v0
    fraction = ((columns[:, None] - u0) * du + (rows[:, None] - v0) * dv) / (du * du + dv * dv + 1.0)
    base, reach = in_camera[:, 0, :, 2, None], in_camera[:, 1, :, 2, None]
    return base + jnp.clip(fraction, 0.0, 1.0) * reach
