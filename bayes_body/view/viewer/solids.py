"""Meshes of a body's parts: tapered cylinders with elliptical sections, and spheres.

The ends of the cylinders are rounded a little, so that the eye does not see gaps at the joints. What cameras see in the model has flat ends.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from bayes_body.model.body.solids import Body

# Corners of a section, sections of an end, and the height of an end as a fraction of its radius.
AROUND, ROUNDED, HEIGHT = 20, 4, 0.4


class Mesh(NamedTuple):
    """A closed surface: corners in the part's frame, metres, and triangles that are seen from outside."""

    vertices: Float[np.ndarray, "vertex 3"]
    faces: Int[np.ndarray, "face 3"]


def part_mesh(body: Body, part: int, radii: Float[np.ndarray, "2"]) -> Mesh:
    """Return the surface of a part; radii of its base and its tip in metres."""
    length, (base, tip) = float(body.lengths[part]), radii
    rise = np.linspace(0, np.pi / 2, ROUNDED + 1)
    if body.topology.is_sphere[part]:
        angle = np.concatenate([-rise[:0:-1], rise])
        return _turned(0.5 * length + base * np.sin(angle), base * np.cos(angle), np.ones(2))
    heights = np.concatenate([-HEIGHT * base * np.sin(rise[::-1]), length + HEIGHT * tip * np.sin(rise)])
    return _turned(heights, np.concatenate([base * np.cos(rise[::-1]), tip * np.cos(rise)]), np.asarray(body.sections[part], float))


def _turned(heights: Float[np.ndarray, " ring"], sizes: Float[np.ndarray, " ring"], section: Float[np.ndarray, "2"]) -> Mesh:
    """Return the surface of rings around z, from below to above; the first and the last have size 0."""
    turn = np.arange(AROUND) * (2 * np.pi / AROUND)
    circle = np.stack([np.cos(turn), np.sin(turn)], axis=-1) * section
    flat = sizes[:, None, None] * circle
    vertices = np.concatenate([flat, np.broadcast_to(heights[:, None, None], (*flat.shape[:2], 1))], axis=-1)
    low = (np.arange(len(heights) - 1)[:, None] * AROUND + np.arange(AROUND)).ravel()
    beside = low - low % AROUND + (low + 1) % AROUND
    faces = np.concatenate([np.stack([low, beside, beside + AROUND], axis=-1), np.stack([low, beside + AROUND, low + AROUND], axis=-1)])
    return Mesh(vertices.reshape(-1, 3), faces)
