"""Joints as frames: what a body file says of a joint, with its fixed dofs turned into constants.

A dof whose limits are equal is fixed. What comes before it among a joint's dofs becomes a frame of its own, on which the fixed turn or shift stands.
"""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from bayes_body.body.check import WORLD
from bayes_body.body.schema import BodySchema
from bayes_body.body.skeleton import preset_rotation
from bayes_body.body.tables import Dof, Joint, Offset


class Frame(NamedTuple):
    """A joint's frame in its parent's: moved by `offset` (metres), turned by `rotation`, then by its dofs, none of which is fixed."""

    name: str
    parent: str
    offset: Float[np.ndarray, "3"]
    rotation: Float[np.ndarray, "3 3"]
    dofs: tuple[Dof, ...]


def frames_of(schema: BodySchema, lengths: Mapping[str, float]) -> list[Frame]:
    """All frames, parents first; a joint's last frame has its name."""
    return [frame for joint in _parents_first(schema) for frame in _split(joint, lengths)]


def vector(offset: Offset, lengths: Mapping[str, float]) -> list[float]:
    """An offset's components, metres."""

    def metres(value: float | str) -> float:
        if not isinstance(value, str):
            return value
        sign = -1.0 if value.startswith("-") else 1.0
        return sign * lengths[value.lstrip("+-")]

    return [metres(offset.x), metres(offset.y), metres(offset.z)]


def _parents_first(schema: BodySchema) -> list[Joint]:
    placed, waiting = [], list(schema.joints)
    while waiting:
        names = {joint.name for joint in placed} | {WORLD}
        placed += [joint for joint in waiting if joint.parent in names]
        waiting = [joint for joint in waiting if joint.parent not in names]
    return placed


def _split(joint: Joint, lengths: Mapping[str, float]) -> list[Frame]:
    found: list[Frame] = []
    offset, rotation = np.array(vector(joint.offset, lengths)), np.asarray(preset_rotation(joint.preset), float)
    parent, free = joint.parent, []
    for dof in joint.dofs:
        if not dof.is_fixed:
            free.append(dof)
            continue
        if free:
            # The name cannot be a user's: it has a character that no key of a table starts with.
            found.append(Frame(f"#{len(found) + 1} {joint.name}", parent, offset, rotation, tuple(free)))
            parent, free, offset, rotation = found[-1].name, [], np.zeros(3), np.eye(3)
        offset, rotation = (offset + rotation @ _shift(dof), rotation) if dof.is_shift else (offset, rotation @ _turn(dof))
    return [*found, Frame(joint.name, parent, offset, rotation, tuple(free))]


def _axis(dof: Dof) -> Float[np.ndarray, "3"]:
    return np.eye(3)["xyz".index(dof.axis[-1])] * (-1.0 if dof.axis.startswith("-") else 1.0)


def _shift(dof: Dof) -> Float[np.ndarray, "3"]:
    return _axis(dof) * float(dof.limits[0] or 0.0)


def _turn(dof: Dof) -> Float[np.ndarray, "3 3"]:
    from scipy.spatial.transform import Rotation

    return Rotation.from_rotvec(_axis(dof) * np.radians(dof.limits[0] or 0.0)).as_matrix()
