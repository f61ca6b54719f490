"""A body made of tubes, each made of rings around a bent chain of bones: the centres and axes of the rings, and the triangles between them.

A ring's station is measured in bones: 1.25 is a quarter of the way along the second bone. Near a joint the path is a parabola and the rings turn with
it, so the skin continues smoothly across bent knees and elbows.

A surface is made of triangles, with one colour each.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from bayes_body.workshop.simulation.person_bones import Chain, perpendicular
from bayes_body.workshop.simulation.person_motion import unit

# Points per ring; the first is towards the person's left, a quarter further is the front.
ANGLES = 20
# Largest fraction of a bone that the blend at one joint may use.
LONGEST_BLEND = 0.45
_TURN = 2.0 * np.pi * np.arange(ANGLES) / ANGLES
COSINES, SINES = np.cos(_TURN).round(12), np.sin(_TURN).round(12)


class Rings(NamedTuple):
    """Rings over time.

    Attributes:
        centres: (frame, ring, 3), metres.
        tangents: (frame, ring, 3), unit, towards the next ring.
        lateral: (frame, ring, 3), unit, the direction of a ring's first point.
    """

    centres: Float[np.ndarray, "frame ring 3"]
    tangents: Float[np.ndarray, "frame ring 3"]
    lateral: Float[np.ndarray, "frame ring 3"]


def sweep(bones: Chain, stations: Float[np.ndarray, " ring"], blend_m: Float[np.ndarray, " joint"]) -> Rings:
    """Rings along a chain.

    Args:
        bones: the chain.
        stations: positions of the rings, in bones; ascending.
        blend_m: the distance from each joint within which the path bends, limited to `LONGEST_BLEND` of a bone.
    """
    steps = np.diff(bones.points, axis=1)
    lengths, directions = np.linalg.norm(steps, axis=-1), unit(steps)
    bone = np.clip(stations.astype(int), 0, steps.shape[1] - 1)
    fraction = stations - bone
    centres = bones.points[:, bone] + fraction[:, None] * steps[:, bone]
    tangents, lateral = directions[:, bone], bones.laterals[:, bone]
    for joint, reach in enumerate(blend_m):
        lower_m, upper_m = lengths[:, joint, None], lengths[:, joint + 1, None]
        radius = np.maximum(np.minimum(reach, LONGEST_BLEND * np.minimum(lower_m, upper_m)), 1e-6)
        offset = np.where(bone == joint, (fraction - 1.0) * lower_m, np.where(bone == joint + 1, fraction * upper_m, np.inf))
        inside = (np.abs(offset) < radius)[..., None]
        w, r = np.clip(0.5 + 0.5 * offset / radius, 0.0, 1.0)[..., None], radius[..., None]
        direction_in, direction_out = directions[:, None, joint], directions[:, None, joint + 1]
        bent = bones.points[:, None, joint + 1] - (1.0 - w) ** 2 * r * direction_in + w**2 * r * direction_out
        centres = np.where(inside, bent, centres)
        tangents = np.where(inside, unit((1.0 - w) * direction_in + w * direction_out), tangents)
        lateral = np.where(inside, (1.0 - w) * bones.laterals[:, None, joint] + w * bones.laterals[:, None, joint + 1], lateral)
    return Rings(centres, tangents, perpendicular(lateral, tangents))


def sections(
    sides: Float[np.ndarray, "ring 4"], roundness: Float[np.ndarray, " ring"]
) -> tuple[Float[np.ndarray, "ring angle"], Float[np.ndarray, "ring angle"]]:
    """The points of rings in their own planes, made of quarters of superellipses.

    Args:
        sides: half widths to the left, to the right, ahead and behind, metres.
        roundness: the superellipse's exponent; 2 is an ellipse, larger is more rectangular.
    """
    power = 2.0 / roundness[:, None]
    widths = np.where(COSINES >= 0, sides[:, :1], sides[:, 1:2]), np.where(SINES >= 0, sides[:, 2:3], sides[:, 3:4])
    rounds = (np.sign(wave) * np.abs(wave) ** power for wave in (COSINES, SINES))
    x, y = (width * circle for width, circle in zip(widths, rounds, strict=True))
    return x, y


def triangles(rings: list[int]) -> tuple[Int[np.ndarray, "face 3"], Int[np.ndarray, "face 2"]]:
    """The triangles of closed tubes.

    Args:
        rings: number of rings of each tube.

    Returns:
        (face, 3) indices of points: first all rings' points in order, then for each tube the centres of its first and last cap; and (face, 2) the
        ring and the angle that a face belongs to.
    """
    faces, places, first, middles = [], [], 0, sum(rings) * ANGLES
    angles = np.arange(ANGLES)
    next_angles = (angles + 1) % ANGLES
    for tube, count in enumerate(rings):
        start, end, cap = first * ANGLES, (first + count - 1) * ANGLES, middles + 2 * tube
        row = (first + np.arange(count - 1))[:, None] * ANGLES
        a, b, c, d = (np.ravel(index) for index in (row + angles, row + next_angles, row + ANGLES + angles, row + ANGLES + next_angles))
        faces += [np.stack([a, b, c], axis=1), np.stack([b, d, c], axis=1)]
        faces += [np.stack([start + next_angles, start + angles, np.full(ANGLES, cap)], axis=1)]
        faces += [np.stack([end + angles, end + next_angles, np.full(ANGLES, cap + 1)], axis=1)]
        side = np.stack(np.divmod(np.arange((count - 1) * ANGLES) + first * ANGLES, ANGLES), axis=1)
        places += [side, side, np.stack([np.full(ANGLES, first), angles], axis=1), np.stack([np.full(ANGLES, first + count - 1), angles], axis=1)]
        first += count
    return np.concatenate(faces), np.concatenate(places)


class Mesh(NamedTuple):
    """Triangles in the world.

    Attributes:
        vertices: (vertex, 3), metres, z up.
        faces: (face, 3), indices of vertices, anticlockwise as seen from outside.
        colours: (face, 3), reflectance of blue, green, red in [0, 1].
    """

    vertices: Float[np.ndarray, "vertex 3"]
    faces: Int[np.ndarray, "face 3"]
    colours: Float[np.ndarray, "face 3"]
