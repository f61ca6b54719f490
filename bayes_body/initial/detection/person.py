"""The person among the bodies of a visual hull: the largest one that is as tall as a person, without the shadow on the floor."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.spatial import KDTree

from bayes_body.initial.detection.hull import VOXEL_M, Mask, Voxels, bodies, carve
from bayes_body.recording.session.session import CameraSpec

# A person's least height and volume; a crouching adult is larger than both.
LEAST_HEIGHT_M, LEAST_VOLUME_M3 = 0.5, 0.01
# A second body of at least this share of the largest one's volume, and this tall, is a second person.
SECOND_SHARE, SECOND_HEIGHT_M = 0.3, 0.9
# If the lowest voxel is farther from the height 0 than this, the world's origin is not on the floor.
FLOOR_M = 0.25
# A shadow lies on the floor: below the first height, farther than FOOT_M from all that is between the two heights.
SHADOW_M, SHIN_M, FOOT_M = 0.15, 0.45, 0.2


class ChosenBody(NamedTuple):
    """The person's voxels, None if there is no person; and sentences for the reader."""

    voxels: Voxels | None
    notices: tuple[str, ...]


def choose_person(cameras: Sequence[CameraSpec], masks: Sequence[Mask], up: int) -> ChosenBody:
    """The largest person in the hull of two or more cleaned masks; `up` is the index of the world's axis that points up."""
    people = [body for body in bodies(_on_floor(carve(cameras, masks), up)) if _is_person(body, up)]
    if not people:
        return ChosenBody(None, ("the silhouettes have no body in common that is as large as a person",))
    return ChosenBody(people[0], _others(people, up))


def floor_height(centres: Voxels, up: int) -> float:
    """The floor's height: 0, the convention for a session's world, unless the body's lowest voxels are far from it."""
    lowest = float(np.percentile(centres[:, up], 0.5)) - VOXEL_M / 2
    return 0.0 if abs(lowest) <= FLOOR_M else lowest


def _others(people: Sequence[Voxels], up: int) -> tuple[str, ...]:
    first, smaller_bodies = people[0], people[1:]
    others = [body for body in smaller_bodies if len(body) >= SECOND_SHARE * len(first) and np.ptp(body[:, up]) >= SECOND_HEIGHT_M]
    if not others:
        return ()
    count = {1: "two", 2: "three"}.get(len(others), "several")
    sizes = ", ".join(f"{_litres(body):.0f} at {_place(body)}" for body in others)
    return (f"{count} people: the one at {_place(first)} was taken, it is the largest ({_litres(first):.0f} litres; the rest: {sizes})",)


def _litres(body: Voxels) -> float:
    return 1000 * len(body) * VOXEL_M**3


def _place(body: Voxels) -> str:
    return "(" + ", ".join(f"{value:.1f}" for value in body.mean(axis=0)) + ") m"


def _is_person(body: Voxels, up: int) -> bool:
    return bool(len(body) * VOXEL_M**3 >= LEAST_VOLUME_M3 and np.ptp(body[:, up]) >= LEAST_HEIGHT_M)


def _on_floor(centres: Voxels, up: int) -> Voxels:
    """The hull above the floor, without the shadow on it."""
    body_voxels = bodies(centres)
    if not body_voxels:
        return centres
    above = centres[:, up] - floor_height(body_voxels[0], up)
    level = np.delete(centres, up, axis=1)
    standing = (above > SHADOW_M) & (above < SHIN_M)
    if not standing.any():
        return centres
    distance = KDTree(level[standing]).query(level, distance_upper_bound=FOOT_M)[0]
    return centres[(above > SHADOW_M) | ((distance < FOOT_M) & (above > -VOXEL_M))]
