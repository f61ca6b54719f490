"""A posed body in a camera's image: the outline of every part, and the silhouette of the whole body.

The outline of a tapered cylinder is the convex hull of its two end sections. The outline of a sphere is that of the circle that faces the camera.
"""

from typing import NamedTuple

import cv2
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from bayes_body.base.geometry import transforms
from bayes_body.base.geometry.camera import Camera, project
from bayes_body.base.shapes import Configuration
from bayes_body.model.body.solids import Body, facing_discs, part_transforms, widened
from bayes_body.model.build import Model
from bayes_body.recording.readers.camera_path import cameras_at
from bayes_body.recording.session.session import Session

POINTS = 24


class Outline(NamedTuple):
    """A part's outline in one image: a convex polygon of (column, row) pixels."""

    part: str
    polygon: Float[np.ndarray, "corner 2"]


def outlines(model: Model, pose: Float[np.ndarray, "*shape"]) -> list[list[Outline]]:
    """Return, for each camera, the outline of every part that is entirely in front of it; pose in radians and metres."""
    pixels, visible = (np.asarray(out) for out in _project_rims(model.body, model.rig, jnp.asarray(pose)))
    names = model.body.topology.names
    return [
        [Outline(name, cv2.convexHull(camera[p].astype(np.float32))[:, 0]) for p, name in enumerate(names) if in_front[p].all()]
        for camera, in_front in zip(pixels, visible, strict=True)
    ]


def seen_in(model: Model, session: Session, index: int) -> Model:
    """Return the model with its cameras at their positions in a frame.

    Raises:
        InputError: a moving camera's file cannot be read.
    """
    return model.at(cameras_at(session, index)) if session.moves else model


def projected_masks(model: Model, pose: Float[np.ndarray, "*shape"], session: Session) -> list[Bool[np.ndarray, "row column"]]:
    """Return the silhouette of a posed body in each camera's image; moving cameras are where the model has them (`seen_in`)."""
    return [fill(polygons, view.camera.size_px) for polygons, view in zip(outlines(model, pose), session.views, strict=True)]


def fill(polygons: list[Outline], size_px: tuple[int, int]) -> Bool[np.ndarray, "row column"]:
    """Return the union of outlines as a mask of an image of `size_px` (width, height)."""
    mask = np.zeros(size_px[::-1], np.uint8)
    # Fixed-point pixels with four fractional bits, so that small parts do not jump by whole pixels.
    for outline in polygons:
        cv2.fillConvexPoly(mask, np.round(outline.polygon * 16).astype(np.int32), 1, shift=4)
    return mask.astype(bool)


def intersection_over_union(a: Bool[np.ndarray, "row column"], b: Bool[np.ndarray, "row column"]) -> float:
    """Return |a ∩ b| / |a ∪ b|; NaN if both are empty."""
    union = np.count_nonzero(a | b)
    return np.count_nonzero(a & b) / union if union else float("nan")


@jax.jit
def _project_rims(body: Body, rig: Camera, pose: Configuration) -> tuple[Array, Array]:
    T_world_part, shaped = part_transforms(body, pose), widened(body, pose)
    return jax.vmap(lambda camera: project(camera, _rims(shaped, T_world_part, camera)))(rig)


def _rims(body: Body, T_world_part: transforms.Transform, camera: Camera) -> Float[Array, "part point 3"]:
    angle = jnp.arange(POINTS) * (2 * jnp.pi / POINTS)
    cos, sin = jnp.cos(angle)[:, None], jnp.sin(angle)[:, None]
    ends = []
    for end in (0, 1):
        centre = T_world_part.origin + end * body.lengths[:, None] * T_world_part.z
        across_x = (body.outline_radii[:, end] * body.sections[:, 0])[:, None] * T_world_part.x
        across_y = (body.outline_radii[:, end] * body.sections[:, 1])[:, None] * T_world_part.y
        ends.append(centre[:, None] + cos * across_x[:, None] + sin * across_y[:, None])
    cylinders = jnp.concatenate(ends, axis=1)
    facing = facing_discs(body, T_world_part, camera.viewpoint)
    disc = facing.centre[:, None] + body.outline_radii[:, :1, None] * (cos * facing.right[:, None] + sin * facing.up[:, None])
    is_sphere = jnp.array(body.topology.is_sphere)[:, None, None]
    return jnp.where(is_sphere, jnp.concatenate([disc, disc], axis=1), cylinders)
