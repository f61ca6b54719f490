r"""The parts of a body as solids, their projection to a camera, and the space in which a body is placed.

A tapered cylinder has the ends $e_0, e_1 = e_0 + \ell a$, radii $r_0, r_1$ and an elliptical section with semi-axes $(r s_x, r s_y)$ along its own
x and y. For a view along $c$ (in the part's frame), the contour point of a section is where the normal is perpendicular to the view,

$$p_\pm = e \pm r\,(s_x \cos\theta,\ s_y \sin\theta), \qquad (\cos\theta, \sin\theta) \propto (c_y / s_y,\ -c_x / s_x),$$

For a circular section this is the occluding contour of Poon & Fleet (2002, 3.2), $e \pm r (a \times c)/\|a \times c\|$. Only the component of the
view perpendicular to the axis matters, and it is the same at both ends. A sphere appears as the disc through its centre perpendicular to the view.

Every point that a likelihood reads is therefore a sum of four vectors of its part, $V_0 + \alpha V_1 + \beta V_2 + \gamma V_3$, with fixed
coefficients: $(1, t, s, ts)$ on a cylinder, with $t \in [0, 1]$ along and $s \in [-1, 1]$ across it. The outline is $s = \pm 1$; surface samples are
points in between, on the patch that faces the camera.

A body is placed by a pose, or by the transforms of its parts.
"""

from dataclasses import dataclass, replace
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from bayes_body.base.geometry import transforms
from bayes_body.base.geometry.namespaces import device_array
from bayes_body.base.geometry.transforms import Transform
from bayes_body.base.shapes import Configuration, Vector3
from bayes_body.density.spaces import SE3, Flat, Plate, Space, flat
from bayes_body.model.body.placement import ByAngles, ByParts, Placement
from bayes_body.model.body.skeleton import Markers, Skeleton


@dataclass(frozen=True)
class PartTopology:
    """The static side of the parts: names, each part's joint, which parts are spheres, and which pairs must not penetrate.

    `widths`: the part ends that a dof widens, as (part, 0 for base or 1 for tip, dof).
    """

    names: tuple[str, ...]
    joints: tuple[int, ...]
    is_sphere: tuple[bool, ...]
    penetration: tuple[tuple[int, int], ...]
    spheres_per_part: int
    widths: tuple[tuple[int, int, int], ...] = ()


@partial(
    jax.tree_util.register_dataclass,
    meta_fields=["name", "topology"],
    data_fields=["skeleton", "markers", "presets", "offsets", "lengths", "radii", "outline_radii", "sections", "placement"],
)
@dataclass(frozen=True)
class Body:
    """The body of one subject: skeleton, markers, solids.

    Lengths, offsets and radii (base, tip) in metres; sections are scale factors in x and y. `radii` are those of the solids, which cannot penetrate
    each other. `outline_radii` are those that cameras see, clothes included.
    """

    name: str
    topology: PartTopology
    skeleton: Skeleton
    markers: Markers
    presets: Float[Array, "part 3 3"]
    offsets: Float[Array, "part 3"]
    lengths: Float[Array, " part"]
    radii: Float[Array, "part 2"]
    outline_radii: Float[Array, "part 2"]
    sections: Float[Array, "part 2"]
    placement: Placement = ByAngles()

    @property
    def dof_names(self) -> tuple[str, ...]:
        """Names of the entries of a pose."""
        return self.skeleton.topology.dof_names

    @property
    def variable(self) -> str:
        """The name of the variable that places the body: `pose`, or `parts`."""
        return self.placement.variable

    @property
    def shapes(self) -> "Shapes":
        """What cameras see of its parts."""
        is_sphere = device_array(self.topology.is_sphere, bool) if any(self.topology.is_sphere) else None
        return Shapes(self.lengths, self.outline_radii, self.sections, is_sphere)

    @property
    def by_angles(self) -> "Body":
        """The same body, placed by joint angles."""
        return replace(self, placement=ByAngles())


def part_transforms(body: Body, configuration: Configuration) -> Transform:
    """`T_world_part` of every part, stacked: rotations (part, 3, 3) and origins (part, 3), metres."""
    joints = transforms.pick(body.placement.joints(body.skeleton, configuration), np.array(body.topology.joints, int))
    return transforms.compose(joints, Transform(body.presets, body.offsets))


def part_axes(body: Body, configuration: Configuration) -> Float[Array, "part 2 3"]:
    """The two ends of each part's axis, metres."""
    T_world_part = part_transforms(body, configuration)
    return jnp.stack([T_world_part.origin, T_world_part.origin + body.lengths[:, None] * T_world_part.z], axis=1)


def widened(body: Body, configuration: Configuration) -> Body:
    """The body with its radii changed by the dofs of axis `width`, which only a pose has."""
    if not body.topology.widths:
        return body
    parts, ends, dofs = (np.array(column) for column in zip(*body.topology.widths, strict=True))
    wider = jnp.zeros_like(body.radii).at[parts, ends].add(configuration[dofs].astype(body.radii.dtype))
    return replace(body, radii=body.radii + wider, outline_radii=body.outline_radii + wider)


class Shapes(NamedTuple):
    """What cameras see of solids: lengths and radii (base, tip; clothes included), metres, scale factors of the sections, and which are spheres.

    `is_sphere` is None if none is.
    """

    lengths: Float[Array, " part"]
    radii: Float[Array, "part 2"]
    sections: Float[Array, "part 2"]
    is_sphere: Bool[Array, " part"] | None


class Patches(NamedTuple):
    """The four vectors V0..V3 of every part for one viewpoint, metres: `V0 + t V1 + s V2 + t s V3` is a point on the patch that faces it."""

    start: Float[Array, "part 3"]
    axis: Float[Array, "part 3"]
    half_width: Float[Array, "part 3"]
    taper: Float[Array, "part 3"]


def patches(body: Body, T_world_part: Transform, viewpoint: Vector3) -> Patches:
    """The visible patch of every part, for a `viewpoint` (metres, world)."""
    return shape_patches(body.shapes, T_world_part, viewpoint)


def shape_patches(shapes: Shapes, T_world_part: Transform, viewpoint: Vector3) -> Patches:
    """The same for solids that are placed one by one."""
    base = T_world_part.origin
    # Base and tip differ along the axis only, so the direction to the contour is the same at both ends.
    side = _side(shapes, T_world_part, base - viewpoint)
    base_radii, tip_radii = shapes.radii[:, :1], shapes.radii[:, 1:]
    cylinders = Patches(base, shapes.lengths[:, None] * T_world_part.z, side * base_radii, side * (tip_radii - base_radii))
    if shapes.is_sphere is None:
        return cylinders
    discs = _discs(shapes, T_world_part, viewpoint)
    is_sphere = shapes.is_sphere[:, None]
    return Patches(*(jnp.where(is_sphere, disc, cylinder) for disc, cylinder in zip(discs, cylinders, strict=True)))


def half_depths(shapes: Shapes, T_world_part: Transform, viewpoint: Vector3) -> Float[Array, "part 3"]:
    """From the axis to the surface that faces a viewpoint, for sections of radius one: half way between the two sides of the contour."""
    view = T_world_part.origin - viewpoint
    cos, sin = _contour(shapes, T_world_part, view)
    depth = _on_section(shapes, T_world_part, -sin, cos)
    return jnp.where(transforms.dot(depth, view)[:, None] > 0, -depth, depth)


def _side(shapes: Shapes, T_world_part: Transform, view: Float[Array, "part 3"]) -> Float[Array, "part 3"]:
    """From the axis to the occluding contour, for a section of radius one."""
    return _on_section(shapes, T_world_part, *_contour(shapes, T_world_part, view))


def _contour(shapes: Shapes, T_world_part: Transform, view: Float[Array, "part 3"]) -> tuple[Float[Array, " part"], Float[Array, " part"]]:
    """The cosine and the sine of the contour's angle (formula of the module)."""
    nx, ny = transforms.dot(view, T_world_part.y) / shapes.sections[:, 1], -transforms.dot(view, T_world_part.x) / shapes.sections[:, 0]
    # For a view exactly end-on the contour is undefined. The clamp keeps it finite; such a part has no visible side anyway.
    scale = jax.lax.rsqrt(jnp.maximum(nx * nx + ny * ny, 1e-12))
    return nx * scale, ny * scale


def _on_section(shapes: Shapes, T_world_part: Transform, cos: Float[Array, " part"], sin: Float[Array, " part"]) -> Float[Array, "part 3"]:
    """The point of a section of radius one at an angle of its ellipse, relative to its centre."""
    sx, sy = shapes.sections[:, 0], shapes.sections[:, 1]
    return (cos * sx)[:, None] * T_world_part.x + (sin * sy)[:, None] * T_world_part.y


def _discs(shapes: Shapes, T_world_part: Transform, viewpoint: Vector3) -> Patches:
    disc = facing_discs(shapes, T_world_part, viewpoint)
    radius = shapes.radii[:, :1]
    # t runs over a diameter: V0 + t V1 goes from -r to r, and the samples' s is reduced to the circle.
    return Patches(disc.centre - radius * disc.up, 2 * radius * disc.up, radius * disc.right, jnp.zeros_like(disc.centre))


class Discs(NamedTuple):
    """Every part as a sphere: its centre (metres, world) and two unit vectors that span the disc facing a viewpoint."""

    centre: Float[Array, "part 3"]
    right: Float[Array, "part 3"]
    up: Float[Array, "part 3"]


def facing_discs(shapes: Body | Shapes, T_world_part: Transform, viewpoint: Vector3) -> Discs:
    """The discs through the middle of every part, perpendicular to the view from `viewpoint`."""
    centre = T_world_part.origin + 0.5 * shapes.lengths[:, None] * T_world_part.z
    view = transforms.unit(centre - viewpoint)
    # For a view along the part's z, the disc is spanned from its x: the vectors change, the disc does not.
    is_end_on = (jnp.abs(transforms.dot(view, T_world_part.z)) > 0.9)[:, None]
    right = transforms.unit(jnp.cross(jnp.where(is_end_on, T_world_part.x, T_world_part.z), view))
    return Discs(centre, right, jnp.cross(view, right))


class Samples(NamedTuple):
    """Coefficients (t, s) of sample points on every part's patch."""

    t: Float[Array, "part sample"]
    s: Float[Array, "part sample"]


def outline_samples(body: Body, per_side: int) -> Samples:
    """Points on both sides of every part's occluding contour, `2 * per_side` per part, evenly spaced."""
    return _samples(body, (np.arange(per_side) + 0.5) / per_side, np.array([-1.0, 1.0]))


def surface_samples(body: Body, steps_along: int, steps_across: int) -> Samples:
    """A grid of `along * across` points on the patch that faces the camera, half a step away from its edge."""
    return _samples(body, (np.arange(steps_along) + 0.5) / steps_along, (2 * np.arange(steps_across) + 1) / steps_across - 1)


def _samples(body: Body, t: np.ndarray, s: np.ndarray) -> Samples:
    grid_t, grid_s = (axis.ravel() for axis in np.meshgrid(t, s))
    # A sphere's outline is a circle: at the height t its half width is that of the chord.
    chord = 2 * np.sqrt(grid_t * (1 - grid_t)) * grid_s
    rows = [chord if sphere else grid_s for sphere in body.topology.is_sphere]
    dtype = body.lengths.dtype
    return Samples(device_array(np.broadcast_to(grid_t, (len(rows), grid_t.size)), dtype), device_array(np.stack(rows), dtype))


class Spheres(NamedTuple):
    """A part as a row of spheres (Sigal et al. 2011, (7)): centres in the world and radii, metres."""

    centres: Float[Array, "part sphere 3"]
    radii: Float[Array, "part sphere"]


def sphere_approximation(body: Body, T_world_part: Transform) -> Spheres:
    """Spheres strung along every part's axis, inscribed in the narrower half-axis of its section."""
    count = body.topology.spheres_per_part
    t = (jnp.arange(count, dtype=body.lengths.dtype) + 0.5) / count
    t = jnp.where(jnp.array(body.topology.is_sphere)[:, None], 0.5, t)
    centres = T_world_part.origin[:, None] + (body.lengths[:, None] * t)[..., None] * T_world_part.z[:, None]
    radii = body.radii[:, :1] * (1 - t) + body.radii[:, 1:] * t
    return Spheres(centres, radii * jnp.min(body.sections, axis=1, keepdims=True))


def penetration_depths(body: Body, T_world_part: Transform) -> Float[Array, " pair"]:
    """The largest penetration of the spheres of each pair in `topology.penetration`, metres; negative if they are apart."""
    if not body.topology.penetration:
        return jnp.zeros((0,), body.lengths.dtype)
    return _deepest(*_sphere_pairs(body, T_world_part)).depth[: len(body.topology.penetration)]


def smooth_penetration_depths(body: Body, T_world_part: Transform) -> Float[Array, " pair"]:
    """The same, for gradients: they go through the deepest spheres of each pair alone, which takes a fraction of the time."""
    if not body.topology.penetration:
        return jnp.zeros((0,), body.lengths.dtype)
    first, second = _sphere_pairs(body, T_world_part)
    deepest = jax.lax.optimization_barrier(_deepest(jax.lax.stop_gradient(first), jax.lax.stop_gradient(second)))
    a, b = (
        sum((jnp.where(chosen == index, spheres[:, index], 0.0) for index in range(spheres.shape[1])), jnp.zeros_like(spheres[:, 0]))
        for chosen, spheres in ((deepest.first, first), (deepest.second, second))
    )
    return _sphere_depth(a, b)[: len(body.topology.penetration)]


# Loops over pairs are compiled to vectors of this length. A shorter rest is computed number by number, which takes longer than the vectors.
LANES = 8


def _sphere_pairs(body: Body, T_world_part: Transform) -> tuple[Float[Array, "xyzr sphere pair"], Float[Array, "xyzr sphere pair"]]:
    """The spheres of the first and of the second part of each pair. Pairs are last, so that everything is elementwise over them.

    Further pairs of empty spheres fill the last lanes.
    """
    spheres, pairs = sphere_approximation(body, T_world_part), np.array(body.topology.penetration)
    table = jnp.concatenate([jnp.transpose(spheres.centres, (2, 1, 0)), spheres.radii.T[None]])
    count = -(-len(pairs) // LANES) * LANES
    chosen = np.zeros((table.shape[-1], 2, count), bool)
    for side in (0, 1):
        chosen[pairs[:, side], side, np.arange(len(pairs))] = True
    # A product with ones and zeros: exact, and with its transpose much faster than picking the columns.
    selected = jnp.dot(table.reshape(-1, table.shape[-1]), jnp.asarray(chosen.reshape(len(chosen), -1), table.dtype), precision="highest")
    selected = jax.lax.optimization_barrier(selected.reshape(*table.shape[:2], 2, count))
    return selected[:, :, 0], selected[:, :, 1]


def _sphere_depth(a: Float[Array, "xyzr pair"], b: Float[Array, "xyzr pair"]) -> Float[Array, " pair"]:
    x, y, z = (a[k] - b[k] for k in range(3))
    # sqrt of a clamped square: its gradient at coinciding centres would be infinite.
    return a[3] + b[3] - jnp.sqrt(jnp.maximum(x * x + y * y + z * z, 1e-12))


class _Deepest(NamedTuple):
    """The depth of the deepest spheres of each pair of parts, and the indices of these spheres in both parts."""

    depth: Float[Array, " pair"]
    first: Int[Array, " pair"]
    second: Int[Array, " pair"]


def _deepest(first: Float[Array, "xyzr sphere pair"], second: Float[Array, "xyzr sphere pair"]) -> _Deepest:
    # Sphere by sphere, all pairs of parts at once: XLA does not vectorise a reduction over two small axes, which takes four times as long.
    indices = jnp.zeros(first.shape[-1], jnp.int32)
    deepest = _Deepest(_sphere_depth(first[:, 0], second[:, 0]), indices, indices)
    for i in range(first.shape[1]):
        for j in range(second.shape[1]):
            depth = _sphere_depth(first[:, i], second[:, j])
            is_deeper = depth > deepest.depth
            deepest = _Deepest(*(jnp.where(is_deeper, new, old) for new, old in zip((depth, i, j), deepest, strict=True)))
    return deepest


def pose_space(body: Body) -> Flat:
    """Return the space of a pose, one axis `dof`: an angle without limits is on the circle, a dof with limits keeps them."""
    topology, low, high = body.skeleton.topology, np.asarray(body.skeleton.low, float), np.asarray(body.skeleton.high, float)
    turning = np.asarray(topology.angular) & ~np.isfinite(low) & ~np.isfinite(high)
    return flat(topology.dof_names, topology.dof_units, tuple(turning.tolist()), tuple(low.tolist()), tuple(high.tolist()), "dof")


def configuration_space(body: Body) -> Space:
    """Return the space of the variable `body.variable`: that of a pose, or rigid transforms with the axes `part` and `coordinate`."""
    placement = body.placement
    return Plate(placement.names, SE3("coordinate"), "part") if isinstance(placement, ByParts) else pose_space(body)
