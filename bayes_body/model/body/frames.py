"""Turn the joints of a body file into frames, with fixed dofs as constants.

A dof with equal limits is fixed. The dofs before it become a separate frame, to which the fixed rotation or translation is attached.
"""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from bayes_body.model.body.check import WORLD
from bayes_body.model.body.schema import BodySchema
from bayes_body.model.body.skeleton import preset_rotation
from bayes_body.model.body.tables import Dof, Joint, Offset


class Frame(NamedTuple):
    """A joint's frame relative to its parent: translated by `offset` (metres), rotated by `rotation`, then moved by its dofs (none is fixed)."""

    name: str
    parent: str
    offset: Float[np.ndarray, "3"]
    rotation: Float[np.ndarray, "3 3"]
    dofs: tuple[Dof, ...]


def frames_of(schema: BodySchema, lengths: Mapping[str, float]) -> list[Frame]:
    """All frames, parents first. A joint's last frame has the joint's name."""
    return [frame for joint in _parents_first(schema) for frame in _split(joint, lengths)]


def vector(offset: Offset, lengths: Mapping[str, float]) -> list[float]:
    """The components of an offset, metres."""

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
    frames: list[Frame] = []
    offset, rotation = np.array(vector(joint.offset, lengths)), preset_rotation(joint.preset)
    parent, free = joint.parent, []
    for dof in joint.dofs:
        if not dof.is_fixed:
            free.append(dof)
            continue
        if free:
            # No user can have chosen this name: TOML keys do not start with this character.
            frames.append(Frame(f"#{len(frames) + 1} {joint.name}", parent, offset, rotation, tuple(free)))
            parent, free, offset, rotation = frames[-1].name, [], np.zeros(3), np.eye(3)
        offset, rotation = (offset + rotation @ _shift(dof), rotation) if dof.is_shift else (offset, rotation @ _turn(dof))
    return [*frames, Frame(joint.name, parent, offset, rotation, tuple(free))]


def _axis(dof: Dof) -> Float[np.ndarray, "3"]:
    return np.eye(3)["xyz".index(dof.axis[-1])] * (-1.0 if dof.axis.startswith("-") else 1.0)


def _shift(dof: Dof) -> Float[np.ndarray, "3"]:
    return _axis(dof) * float(dof.limits[0] or 0.0)


def _turn(dof: Dof) -> Float[np.ndarray, "3 3"]:
    from scipy.spatial.transform import Rotation

    return Rotation.from_rotvec(_axis(dof) * np.radians(dof.limits[0] or 0.0)).as_matrix()
