"""Convert a body file to the arrays of one subject's body: metres, radians.

The joints of a body file become frames, and fixed dofs become constants. A dof with equal limits is fixed. The dofs before it become a separate
frame, to which the fixed rotation or translation is attached.
"""

import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from bayes_body.base.errors import input_error, nearest
from bayes_body.base.geometry.namespaces import device_array
from bayes_body.model.body.schema import WORLD, BodySchema
from bayes_body.model.body.skeleton import Markers, Motion, Skeleton, Topology, preset_rotation
from bayes_body.model.body.solids import Body, PartTopology
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


class Shape(NamedTuple):
    """A subject's measurements, by name. What is missing follows from the height and the body file's proportions."""

    height_m: float | None = None
    lengths_m: Mapping[str, float] = {}
    radii_m: Mapping[str, tuple[float, float]] = {}
    sections: Mapping[str, tuple[float, float]] = {}
    outline_radii_m: Mapping[str, tuple[float, float]] = {}


def build_body(name: str, schema: BodySchema, shape: Shape = Shape()) -> Body:
    """Build the body of one subject.

    Raises:
        InputError: the shape names an unknown length or part.
    """
    _check_names(name, schema, shape)
    height = shape.height_m or schema.height_m
    lengths = {key: share * height for key, share in schema.lengths_of_height.items()} | dict(shape.lengths_m)
    frames = frames_of(schema, lengths)
    joint_index = {frame.name: j for j, frame in enumerate(frames)}
    parts = schema.parts
    radii = {part.name: shape.radii_m.get(part.name, tuple(r * height for r in part.radius_of_height)) for part in parts}
    outline = radii | dict(shape.outline_radii_m)
    return Body(
        name=name,
        topology=PartTopology(
            names=tuple(part.name for part in parts),
            joints=tuple(joint_index[part.joint] for part in parts),
            is_sphere=tuple(part.kind == "sphere" for part in parts),
            penetration=_pairs(schema),
            spheres_per_part=schema.spheres_per_part,
            widths=_widths(schema, [dof.name for frame in frames for dof in frame.dofs]),
        ),
        skeleton=_skeleton(frames),
        markers=Markers(
            names=tuple(schema.markers),
            joints=tuple(joint_index[marker.joint] for marker in schema.markers.values()),
            offsets=device_array(np.array([vector(marker.offset, lengths) for marker in schema.markers.values()]).reshape(-1, 3)),
        ),
        presets=device_array([preset_rotation(part.preset) for part in parts]),
        offsets=device_array([vector(part.offset, lengths) for part in parts]),
        lengths=device_array([lengths[part.length] for part in parts]),
        # No part is thicker than its outline.
        radii=device_array(np.minimum([radii[part.name] for part in parts], [outline[part.name] for part in parts])),
        outline_radii=device_array([outline[part.name] for part in parts]),
        sections=device_array([shape.sections.get(part.name, part.section) for part in parts]),
    )


def _check_names(name: str, schema: BodySchema, shape: Shape) -> None:
    parts = [part.name for part in schema.parts]
    for field, measures, allowed in (
        ("lengths_m", shape.lengths_m, schema.lengths_of_height),
        ("radii_m", shape.radii_m, parts),
        ("outline_radii_m", shape.outline_radii_m, parts),
        ("sections", shape.sections, parts),
    ):
        for key in measures:
            if key not in allowed:
                raise input_error(f"subject.{field}.{key}", "no such name", f"a name of the body '{name}'", nearest(key, allowed))


def _pairs(schema: BodySchema) -> tuple[tuple[int, int], ...]:
    index = {part.name: p for p, part in enumerate(schema.parts)}
    return tuple((index[a], index[b]) for a, b in schema.penetration)


def _widths(schema: BodySchema, dofs: Sequence[str]) -> tuple[tuple[int, int, int], ...]:
    """(part, end, dof) for each end of a part that a free dof widens."""
    named = [(p, end, name) for p, part in enumerate(schema.parts) for end, name in enumerate(part.widened)]
    return tuple((p, end, dofs.index(name)) for p, end, name in named if name in dofs)


def _skeleton(frames: Sequence[Frame]) -> Skeleton:
    index = {frame.name: j for j, frame in enumerate(frames)} | {WORLD: -1}
    dofs = [dof for frame in frames for dof in frame.dofs]
    order = {dof.name: k for k, dof in enumerate(dofs)}
    topology = Topology(
        joint_names=tuple(frame.name for frame in frames),
        parents=tuple(index[frame.parent] for frame in frames),
        motions=tuple(tuple(_motion(order[dof.name], dof) for dof in frame.dofs) for frame in frames),
        dof_names=tuple(order),
        dof_units=tuple("m" if dof.is_shift else "rad" for dof in dofs),
    )
    low, high = np.array([_limits(dof) for dof in dofs]).reshape(-1, 2).T
    return Skeleton(
        topology=topology,
        presets=device_array([frame.rotation for frame in frames]),
        offsets=device_array([frame.offset for frame in frames]),
        low=device_array(low),
        high=device_array(high),
    )


def _motion(index: int, dof: Dof) -> Motion:
    if dof.is_width:
        return Motion(dof=index, axis=0, sign=0, is_shift=True)
    return Motion(dof=index, axis="xyz".index(dof.axis[-1]), sign=-1 if dof.axis.startswith("-") else 1, is_shift=dof.is_shift)


def _limits(dof: Dof) -> tuple[float, float]:
    low, high = dof.limits
    if low is None or high is None:
        return (-math.inf, math.inf)
    return (low, high) if dof.is_shift else (math.radians(low), math.radians(high))
