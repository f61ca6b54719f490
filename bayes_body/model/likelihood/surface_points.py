r"""Points of a body's parts that a camera sees now, and where the same points were in the frame before.

The points of a part are fixed in coordinates t along its axis and s across it. With the vectors $V_0..V_3$ of the patch that faces the camera
(model/body/solids.py), a point of the patch is $V_0 + t V_1 + s V_2 + t s V_3$. A point of the surface is nearer to the camera by $\sqrt{1 - s^2}$ of
the half depth of the part, which $V_4 + t V_5$ points along. All of them move rigidly with the part, so the vectors are carried to the frame before
once for all points. A sphere is a disc: its half-width at t is the chord.

Parts are ordered by the depths of their middles. A point is covered where it lies in the outline of a nearer part.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from bayes_body.base.geometry import camera as cameras
from bayes_body.base.geometry import transforms
from bayes_body.base.geometry.camera import Camera, Pixels
from bayes_body.base.geometry.transforms import Transform
from bayes_body.model.body.solids import Body, half_depths, shape_patches

# A surface or an axis that is seen at a smaller cosine counts as this, so that the noise stays finite. Its visibility is as small.
LEAST_COSINE = 0.05

type Vectors = Float[Array, "6 part 3"]
type Coefficients = Float[Array, "6 part sample"]


class CarriedPoints(NamedTuple):
    """The same points of all parts in two frames, for each camera.

    Attributes:
        pixels: their pixels in this frame.
        previous_pixels: their pixels in the frame before.
        cosine: of the angle between the axis and the image plane, or between the surface's normal and the view: from LEAST_COSINE to 1.
        covered: whether a nearer part covers the point in this frame.
    """

    pixels: Pixels[Float[Array, "camera part sample"]]
    previous_pixels: Pixels[Float[Array, "camera part sample"]]
    cosine: Float[Array, "camera part sample"]
    covered: Bool[Array, "camera part sample"]


def carried_points(
    body: Body, rigs: tuple[Camera, Camera], placed: tuple[Transform, Transform], places: Float[Array, "sample 2"], on_surface: bool
) -> CarriedPoints:
    """Return the points that each camera sees of the parts.

    Args:
        body: the body, metres.
        rigs: the cameras in this frame and in the frame before.
        placed: `T_world_part` of all parts in this frame and in the frame before, metres.
        places: t from 0 to 1 and s from -1 to 1, for every part.
        on_surface: whether points lie on the surface, not on the patch through the axis.
    """
    T_world_part, previous_T_world_part = placed
    coefficients = _coefficients(body, places, on_surface)

    def camera_points(camera: Camera, earlier: Camera) -> CarriedPoints:
        vectors, depth = _vectors(body, T_world_part, camera)
        pixels = _pixels(camera, vectors, coefficients)
        axis = body.lengths[:, None] * T_world_part.z
        middle = T_world_part.origin + axis / 2
        cosine = (
            _surface_cosine(body, T_world_part, camera, coefficients, depth)
            if on_surface
            else _axis_cosine(body, T_world_part.z, middle - camera.viewpoint)
        )
        shown = jnp.broadcast_to(cosine if cosine.ndim > 1 else cosine[:, None], pixels.u.shape)
        return CarriedPoints(
            pixels,
            _pixels(earlier, _carried(vectors, T_world_part, previous_T_world_part), coefficients),
            jnp.maximum(shown, LEAST_COSINE),
            _covered(body, camera, vectors, pixels, cameras.to_camera(camera, middle)[:, 2]),
        )

    return jax.vmap(camera_points)(*rigs)


def _coefficients(body: Body, places: Float[Array, "sample 2"], on_surface: bool) -> Coefficients:
    """The factors of V0..V5 for each point."""
    t, s = places[:, 0], places[:, 1]
    # A sphere's chord at t is 2 sqrt(t (1 - t)) radii wide.
    chord = jnp.where(jnp.array(body.topology.is_sphere)[:, None], 2 * jnp.sqrt(jnp.maximum(t * (1 - t), 0.0)), 1.0)
    offset = s * chord
    depth = chord * jnp.sqrt(jnp.maximum(1 - s * s, 0.0)) if on_surface else jnp.zeros_like(offset)
    t = jnp.broadcast_to(t, offset.shape)
    return jnp.stack([jnp.ones_like(t), t, offset, t * offset, depth, t * depth])


def _vectors(body: Body, T_world_part: Transform, camera: Camera) -> tuple[Vectors, Float[Array, "part 3"]]:
    """V0..V5 of every part in the world, and the half depth of a section of radius one, towards the camera."""
    patches = shape_patches(body.shapes, T_world_part, camera.viewpoint)
    base, tip = body.outline_radii[:, :1], body.outline_radii[:, 1:]
    is_sphere = jnp.array(body.topology.is_sphere)[:, None]
    depth = jnp.where(is_sphere, _towards(body, T_world_part, camera), half_depths(body.shapes, T_world_part, camera.viewpoint))
    return jnp.stack([*patches, depth * base, jnp.where(is_sphere, 0.0, depth * (tip - base))]), depth


def _towards(body: Body, T_world_part: Transform, camera: Camera) -> Float[Array, "part 3"]:
    """The unit vector from the middle of a part to the camera."""
    return transforms.unit(camera.viewpoint - T_world_part.origin - body.lengths[:, None] / 2 * T_world_part.z)


def _carried(vectors: Vectors, T_world_part: Transform, previous_T_world_part: Transform) -> Vectors:
    """The vectors of the same points in the frame before."""
    back = jnp.swapaxes(T_world_part.rotation, -1, -2)

    def turned(vector: Float[Array, "part 3"]) -> Float[Array, "part 3"]:
        return transforms.turn(previous_T_world_part.rotation, transforms.turn(back, vector))

    start = previous_T_world_part.origin + turned(vectors[0] - T_world_part.origin)
    return jnp.stack([start, *(turned(vector) for vector in vectors[1:])])


def _pixels(camera: Camera, vectors: Vectors, coefficients: Coefficients) -> Pixels[Float[Array, "part sample"]]:
    in_camera = cameras.to_camera(camera, vectors).at[0].add(camera.translation)
    # By components: one sum of six products each, instead of arrays whose last axis is three.
    X, Y, Z = (jnp.sum(coefficients * in_camera[:, :, k, None], axis=0) for k in range(3))
    return cameras.project_components(camera, X, Y, Z)


def _axis_cosine(body: Body, axis: Float[Array, "part 3"], view: Float[Array, "part 3"]) -> Float[Array, " part"]:
    """Of the angle between an axis and the plane across the view; 1 for a sphere."""
    sine = transforms.dot(axis, transforms.unit(view))
    return jnp.where(jnp.array(body.topology.is_sphere), 1.0, jnp.sqrt(jnp.maximum(1 - sine * sine, LEAST_COSINE**2)))


def _surface_cosine(
    body: Body, T_world_part: Transform, camera: Camera, coefficients: Coefficients, depth: Float[Array, "part 3"]
) -> Float[Array, "part sample"]:
    """Of the angle between the surface's normal and the view to the part's middle."""
    view = -_towards(body, T_world_part, camera)
    # Of a circular section, the normal is s across and sqrt(1 - s²) towards the camera, perpendicular to the axis. Sections that are not circular
    # count as circular here.
    facing = -transforms.dot(transforms.unit(depth), view)
    return facing[:, None] * coefficients[4]


def _covered(
    body: Body, camera: Camera, vectors: Vectors, pixels: Pixels[Float[Array, "part sample"]], depths: Float[Array, " part"]
) -> Bool[Array, "part sample"]:
    """Whether a point lies in the outline of a part whose middle is nearer to the camera."""
    outline = _pixels(camera, vectors, _corners(body, vectors.dtype))
    u, v = (jnp.stack([corners, jnp.roll(corners, 1, axis=1)]) for corners in (outline.u, outline.v))
    du, dv = u[0] - u[1], v[0] - v[1]
    # A point is inside where it is on the inner side of all four edges: a u + b v + c > 0 for each.
    turn = jnp.sign(jnp.sum(u[1] * v[0] - u[0] * v[1], axis=1, keepdims=True))
    c = jnp.where(jnp.all(outline.visible, axis=1, keepdims=True), turn * (dv * u[1] - du * v[1]), -jnp.inf)
    a, b = -turn * dv, turn * du
    covered = jnp.zeros(pixels.u.shape, bool)
    # Part by part: XLA's CPU backend makes one vectorised loop over the points of this, and a slow one of an array (part, part, sample).
    for part in range(len(depths)):
        inner = [a[part, k] * pixels.u + b[part, k] * pixels.v + c[part, k] for k in range(4)]
        within = jnp.minimum(jnp.minimum(inner[0], inner[1]), jnp.minimum(inner[2], inner[3])) > 0
        covered = covered | (within & (depths[part] < depths)[:, None])
    return covered


def _corners(body: Body, dtype: Any) -> Coefficients:
    """The coefficients of the corners of every part's outline: of a cylinder's patch, and of the square that is as large as a sphere's disc."""
    t, s = np.array([0.0, 1.0, 1.0, 0.0]), np.array([-1.0, -1.0, 1.0, 1.0])
    half = np.where(np.array(body.topology.is_sphere), np.sqrt(np.pi) / 2, 1.0)[:, None]
    t, s = 0.5 + half * (t - 0.5), half * s
    return jnp.asarray(np.stack([np.ones_like(t), t, s, t * s, np.zeros_like(t), np.zeros_like(t)]), dtype)
