"""The schema of a body file, with checks beyond its types.

The tables must fit together. Unknown names, duplicate names and a joint hierarchy that is not a tree are errors.
"""

from collections import Counter
from collections.abc import Iterable, Iterator

from pydantic import model_validator

from bayes_body.base.errors import nearest
from bayes_body.model.body.tables import SEGMENTS, BodyTables, Offset

WORLD = "world"


def faults(body: BodyTables) -> list[str]:
    """All faults, one sentence each; empty for a valid body."""
    return [*_duplicate_names(body), *_unknown_names(body), *_cycles(body), *_widths(body), *_segments(body)]


def _duplicate_names(body: BodyTables) -> Iterator[str]:
    for kind, names in (
        ("joint", [joint.name for joint in body.joints]),
        ("part", [part.name for part in body.parts]),
        ("dof", [dof.name for joint in body.joints for dof in joint.dofs]),
    ):
        for name, count in Counter(names).items():
            if count > 1:
                yield f"{kind} '{name}' is defined {count} times; give each {kind} a unique name"


def _unknown_names(body: BodyTables) -> Iterator[str]:
    joints = {joint.name for joint in body.joints}
    parts = {part.name for part in body.parts}
    for joint in body.joints:
        if joint.parent not in joints | {WORLD}:
            yield f"joint '{joint.name}': parent '{joint.parent}' is not a joint; {nearest(joint.parent, joints | {WORLD})}"
        yield from _unknown_lengths(body, f"joint '{joint.name}'", joint.offset)
    for kind, item in [("part", part) for part in body.parts] + [("marker", marker) for marker in body.markers.items()]:
        name, thing = item if isinstance(item, tuple) else (item.name, item)
        if thing.joint not in joints:
            yield f"{kind} '{name}': joint '{thing.joint}' does not exist; {nearest(thing.joint, joints)}"
        yield from _unknown_lengths(body, f"{kind} '{name}'", thing.offset)
    for part in body.parts:
        if part.length not in body.lengths_of_height:
            yield f"part '{part.name}': length '{part.length}' is not in lengths_of_height; {nearest(part.length, body.lengths_of_height)}"
    for name in {name for pair in body.penetration for name in pair} - parts:
        yield f"penetration: '{name}' is not a part; {nearest(name, parts)}"


def _widths(body: BodyTables) -> Iterator[str]:
    widths = {dof.name: dof for joint in body.joints for dof in joint.dofs if dof.is_width}
    named = {name for part in body.parts for name in part.widened if name}
    for part in body.parts:
        for name, share in zip(part.widened, part.radius_of_height, strict=True):
            if name and name not in widths:
                yield f"part '{part.name}': widened by '{name}', which is not a dof of axis 'width'; {nearest(name, widths)}"
            elif name and (widths[name].low_m or 0.0) + share * body.height_m <= 0:
                low = f"low_m = {widths[name].low_m:g} of '{name}'"
                yield f"part '{part.name}': {low} removes the whole radius of {share * body.height_m:.3g} m; give a larger low_m"
    for name, dof in widths.items():
        if dof.low_m is None:
            yield f"dof '{name}' is a width without limits; give low_m and high_m"
        if name not in named:
            yield f"dof '{name}' widens no part; name it in a part's `widened`, or remove it"


def _segments(body: BodyTables) -> Iterator[str]:
    joints = {joint.name for joint in body.joints}
    for name, segment in body.clinical.items():
        if name not in SEGMENTS:
            yield f"clinical segment '{name}' is unknown; {nearest(name, SEGMENTS)}"
        if segment.joint not in joints:
            yield f"clinical segment '{name}': joint '{segment.joint}' does not exist; {nearest(segment.joint, joints)}"
        if segment.forward[-1] == segment.up[-1]:
            problem = f"forward = '{segment.forward}' and up = '{segment.up}' are the same axis"
            yield f"clinical segment '{name}': {problem} of joint '{segment.joint}'; give two different axes"


def _unknown_lengths(body: BodyTables, owner: str, offset: Offset) -> Iterator[str]:
    entries: Iterable[tuple[str, float | str]] = offset
    for axis, value in entries:
        if isinstance(value, str) and value.lstrip("+-") not in body.lengths_of_height:
            yield f"{owner}: offset {axis} = '{value}' is not a length; {nearest(value.lstrip('+-'), body.lengths_of_height)}"


def _cycles(body: BodyTables) -> Iterator[str]:
    parent = {joint.name: joint.parent for joint in body.joints}
    reported: set[str] = set()
    for start in parent:
        path = [start]
        while path[-1] in parent and parent[path[-1]] not in path:
            path.append(parent[path[-1]])
        if path[-1] in parent and start not in reported:
            loop = path[path.index(parent[path[-1]]) :]
            if not reported & set(loop):
                yield f"joints {' -> '.join([*loop, loop[0]])} form a cycle of parents; one of them must have the parent '{WORLD}'"
            reported |= set(path)


class BodySchema(BodyTables):
    """A whole body: a tree of joints, the parts attached to it, and its virtual markers.

    `measured_as` names another body with the same dofs and the same lengths and parts, as far as the other has them. A subject's measurements under
    the other body's names are valid for this one.
    """

    @model_validator(mode="after")
    def _check_references(self) -> "BodySchema":
        sentences = faults(self)
        if sentences:
            raise ValueError("\n".join(sentences))
        return self
