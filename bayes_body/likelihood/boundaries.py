r"""Points on the occluding boundaries of a body's parts, as each camera sees them: where, in which direction, and whether another part hides them.

Samples stand at fixed places of the contour $e \pm r (a \times c)/\|a \times c\|$ (Poon & Fleet 2002, 3.2; body/solids.py), so that they move
smoothly with the pose. One is hidden by another part whose outline it lies in, and whose axis is nearer there: parts are convex, their outlines
quadrilaterals and ellipses. Hard, a sample is hidden or it is not, and a density built on that jumps; soft, it is hidden by the share

$$\sigma(d / h_d)\ \sigma((Z - Z' - m) / h_Z)$$

of its distance d inside the outline and its depth Z behind the axis, Z', with the margin m.
"""

from typing import Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from bayes_body.body.solids import Body, Samples, outline_samples
from bayes_body.geometry.camera import Camera, Pixels
from bayes_body.likelihood.outlines import forms_of
from bayes_body.likelihood.patch_pixels import by_component, corner_pixels, sample_pixels

type Visibility = Literal["hard", "soft"]
type Grid = Float[Array, "camera part sample"]
type Seen = Float[Array, "camera 4 part 3"]

# In soft visibility: the width of an outline's edge, pixels, and of "nearer", metres.
SOFT_PX, SOFT_M = 1.5, 0.02
# How much nearer an axis must be: neighbours along a limb meet at the joint.
MARGIN_M = 0.03


class Contour(NamedTuple):
    """Samples of every part's contour: coefficients (t, s), and how they change along the contour."""

    samples: Samples
    along: Samples


class Boundaries(NamedTuple):
    """What a rig sees of the samples: pixels, unit normals in the image, and the share of each that can be seen, in [0, 1]."""

    pixels: Pixels[Grid]
    normals: tuple[Grid, Grid]
    visible: Grid


def contour(body: Body, per_side: int) -> Contour:
    """`per_side` samples of both sides of every part."""
    samples = outline_samples(body, per_side)
    t, s = (np.asarray(axis) for axis in samples)
    sphere = np.array(body.topology.is_sphere)[:, None]
    # Of a circle t = (1 + sin α) / 2, s = ± cos α.
    along_t = np.where(sphere, np.sqrt(np.maximum(t * (1 - t), 0)), 1.0)
    along_s = np.where(sphere, -np.sign(s) * (2 * t - 1), 0.0)
    dtype = body.lengths.dtype
    return Contour(samples, Samples(jnp.asarray(along_t, dtype), jnp.asarray(along_s, dtype)))


def boundaries(body: Body, rig: Camera, contour: Contour, seen: Seen, visibility: Visibility) -> Boundaries:
    """The samples of the parts' patches, `seen` in each camera's frame (`patch_pixels.seen_patches`)."""
    pixels = sample_pixels(rig, seen, contour.samples)
    depths, normals = jax.vmap(_direction, (0, 0, None))(rig, seen, contour)
    shown = _share(_inside_image(rig, pixels), SOFT_PX, visibility) * _shown(body, rig, seen, pixels, depths, visibility)
    return Boundaries(pixels, normals, jnp.where(pixels.visible, shown, 0.0))


def _direction(camera: Camera, seen: Float[Array, "4 part 3"], contour: Contour) -> tuple[Float[Array, "part sample"], tuple[Array, Array]]:
    """Depth of each sample, metres, and the unit normal of its contour in the image; the lens's distortion turns it by too little to count."""
    (t, s), (dt, ds), patches = contour.samples, contour.along, by_component(seen)
    X, Y, Z = (p.start + p.along * t + p.across * s + p.taper * (t * s) for p in patches)
    to_x, to_y, to_z = (dt * (p.along + s * p.taper) + ds * (p.across + t * p.taper) for p in patches)
    # Along the contour in the image, but for a factor.
    du = camera.focal[0] * ((to_x * Z - X * to_z) + camera.skew * (to_y * Z - Y * to_z))
    dv = camera.focal[1] * (to_y * Z - Y * to_z)
    # Seen exactly along its axis a side is a point: any direction is as good, as long as it is finite.
    scale = jax.lax.rsqrt(du * du + dv * dv + (1e-6 * camera.focal[0]) ** 2)
    return Z, (-dv * scale, du * scale)


def _inside_image(rig: Camera, pixels: Pixels[Grid]) -> Grid:
    """How far inside the image, pixels."""
    width, height = (rig.size[:, k, None, None] for k in (0, 1))
    return jnp.minimum(jnp.minimum(pixels.u, width - 1 - pixels.u), jnp.minimum(pixels.v, height - 1 - pixels.v))


def _share(value: Array, width: float, visibility: Visibility) -> Array:
    """1 where the value is above 0, else 0; soft, with a ramp of that width."""
    return (value > 0).astype(value.dtype) if visibility == "hard" else jax.nn.sigmoid(value / width)


def _shown(body: Body, rig: Camera, seen: Seen, pixels: Pixels[Grid], depths: Grid, visibility: Visibility) -> Grid:
    """The share of each sample that no other part hides."""
    cameras, parts, samples = depths.shape
    forms = forms_of(body.topology, rig, seen)
    ends = corner_pixels(rig, seen, np.repeat([[0.0], [1.0]], parts, axis=1).astype(seen.dtype), np.zeros((2, parts), seen.dtype))
    middles = [rig.size[:, k, None, None] / 2 for k in (0, 1)]
    columns, rows = ((x - middle).reshape(cameras, -1) for x, middle in zip((pixels.u, pixels.v), middles, strict=True))
    inside = jax.vmap(_insides)(forms, columns, rows)
    nearer = depths.reshape(cameras, 1, -1) - _axis_depths(seen, (ends.u - middles[0], ends.v - middles[1]), columns, rows)
    covers = _share(inside, SOFT_PX, visibility) * _share(nearer - MARGIN_M, SOFT_M, visibility)
    others = jnp.asarray(1 - np.repeat(np.eye(parts), samples, axis=1), depths.dtype)
    return jnp.prod(1 - covers * others, axis=1).reshape(depths.shape)


def _insides(forms: Float[Array, "coefficient 4 part"], columns: Float[Array, " point"], rows: Float[Array, " point"]) -> Float[Array, "part point"]:
    """How far inside of each part's outline, pixels (likelihood/outlines.py); of a sphere all four forms are one and the same."""
    basis = [jnp.ones_like(columns), columns, rows, columns * columns, columns * rows, rows * rows][: forms.shape[0]]
    sides = sum(form[:, :, None] * each for form, each in zip(forms, basis, strict=True))
    return jnp.min(sides, axis=0)


def _axis_depths(seen: Seen, ends: tuple[Array, Array], columns: Float[Array, "camera point"], rows: Array) -> Float[Array, "camera part point"]:
    """The depth of each part's axis where it comes nearest to a point in the image, metres."""
    (u0, u1), (v0, v1) = ((x[:, 0, :, None], x[:, 1, :, None]) for x in ends)
    du, dv = u1 - u0, v1 - v0
    along = ((columns[:, None] - u0) * du + (rows[:, None] - v0) * dv) / (du * du + dv * dv + 1.0)
    base, reach = seen[:, 0, :, 2, None], seen[:, 1, :, 2, None]
    return base + jnp.clip(along, 0.0, 1.0) * reach
