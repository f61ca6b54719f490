r"""ASF, the skeleton of an Acclaim motion: bones with a direction, a length, an axis and dofs.

With C the rotation of a bone's `axis` and M that of its dofs, a bone rotates by $L = C M C^{-1}$ relative to its parent, and it starts at the
parent's end. Directions and axes are given in the world frame at rest. `order` and `axis XYZ` rotate about x first. The root's `orientation` rotates
the whole skeleton. Metres are value × 0.0254 / length, with the `length` of `:units`: the file's unit is an inch divided by it (J. Lander: Working
with motion capture file formats, 1998; mocap.cs.cmu.edu).
"""

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from bayes_body.base.errors import input_error
from bayes_body.recording.readers.mocap.text import numbers, read_text
from bayes_body.recording.readers.mocap.tree import turns

KIND = "an ASF skeleton (:units, :root, :bonedata, :hierarchy)"
RESTORE = "restore the file"
INCH_M = 0.0254
ROOT = "root"
SECTIONS = ("root", "bonedata", "hierarchy")
ROOT_ORDER = "TX TY TZ RX RY RZ"


class Line(NamedTuple):
    """A line's number and words."""

    number: int
    words: list[str]


class Bone(NamedTuple):
    """A bone; the root is a bone without extent.

    Attributes:
        name: the name in the file.
        offset: from its start to its end at rest, in the file's unit.
        axis: C.
        dofs: in the order of their values in the motion file: `rx`, `ry`, `rz`, and for the root also `tx`, `ty`, `tz`.
    """

    name: str
    offset: Float[np.ndarray, "3"]
    axis: Float[np.ndarray, "3 3"]
    dofs: tuple[str, ...]


class Skeleton(NamedTuple):
    """Bones and units; the root is first, and parents come before their children.

    Attributes:
        bones: the root is the first.
        parents: index of the bone at whose end each bone starts; -1 for the root.
        position: the root's position at rest.
        metres: metres per unit of length.
        degrees: degrees per unit of angle.
    """

    bones: tuple[Bone, ...]
    parents: tuple[int, ...]
    position: Float[np.ndarray, "3"]
    metres: float
    degrees: float


def read_asf(path: Path) -> Skeleton:
    """The skeleton of a file.

    Raises:
        InputError: the file cannot be read or is not ASF; a bone lacks a number; the hierarchy names an unknown bone or omits one.
    """
    sections = _sections(path)
    units = {line.words[0]: line for line in sections.get("units", []) if len(line.words) == 2}
    degrees = float(np.degrees(1)) if "angle" in units and units["angle"].words[1].lower().startswith("rad") else 1.0
    length = float(numbers(f"{path}: line {units['length'].number}", units["length"].words[1:])[0]) if "length" in units else 1.0
    if not length > 0:
        raise input_error(f"{path}: line {units['length'].number}", f"length {length:g}", "a number above 0", RESTORE)
    root, position = _root(path, sections["root"], degrees)
    bones = {ROOT: root} | {bone.name: bone for bone in _bones(path, sections["bonedata"], degrees)}
    parents = _hierarchy(path, sections["hierarchy"], bones)
    order = list(parents)
    return Skeleton(
        tuple(bones[name] for name in order),
        tuple(order.index(parents[name]) if name != ROOT else -1 for name in order),
        position,
        INCH_M / length,
        degrees,
    )


def _sections(path: Path) -> dict[str, list[Line]]:
    """The lines below each keyword, without comments."""
    out: dict[str, list[Line]] = {}
    section: list[Line] = []
    for number, text in enumerate(read_text(path, KIND).splitlines(), 1):
        words = text.split("#")[0].split()
        if words and words[0].startswith(":"):
            section = out.setdefault(words[0][1:].lower(), [])
            words = words[1:]
        if words:
            section.append(Line(number, words))
    missing = [f":{name}" for name in SECTIONS if name not in out]
    if missing:
        raise input_error(path, f"no {', '.join(missing)}", KIND, "name another file, or restore this one")
    return out


def _fields(path: Path, lines: Sequence[Line], counts: Mapping[str, int]) -> dict[str, Line]:
    """The lines of a block by their first word. `counts` gives the number of words that must follow."""
    fields = {line.words[0].lower(): line for line in lines}
    entry = f"{path}: line {lines[0].number}" if lines else str(path)
    for key, count in counts.items():
        if key not in fields:
            raise input_error(entry, f"no {key}", f"{key} and {count} values after it", RESTORE)
        if len(fields[key].words) - 1 != count:
            problem = f"{key} with {len(fields[key].words) - 1} values"
            raise input_error(f"{path}: line {fields[key].number}", problem, f"{count}", RESTORE)
    return fields


def _root(path: Path, lines: Sequence[Line], degrees: float) -> tuple[Bone, Float[np.ndarray, "3"]]:
    fields = _fields(path, lines, {"order": 6, "axis": 1, "position": 3, "orientation": 3})
    order = fields["order"]
    if sorted(word.upper() for word in order.words[1:]) != sorted(ROOT_ORDER.split()):
        raise input_error(f"{path}: line {order.number}", " ".join(order.words)[:60], f"each of {ROOT_ORDER} once", RESTORE)
    position, orientation = (numbers(f"{path}: line {fields[key].number}", fields[key].words[1:]) for key in ("position", "orientation"))
    axis = _axis(path, fields["axis"], degrees * orientation)
    return Bone(ROOT, np.zeros(3), axis, tuple(word.lower() for word in order.words[1:])), position


def _axis(path: Path, line: Line, angles_deg: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3 3"]:
    """C; the line's last word gives the order."""
    order = line.words[-1].lower()
    if sorted(order) != ["x", "y", "z"]:
        raise input_error(f"{path}: line {line.number}", f"axis order '{order[:40]}'", "XYZ in any order", RESTORE)
    return turns(order, angles_deg[None])[0]


def _bones(path: Path, lines: Sequence[Line], degrees: float) -> Iterator[Bone]:
    names = {ROOT}
    for block in _blocks(path, lines):
        bone = _bone(path, block, degrees)
        if bone.name in names:
            raise input_error(f"{path}: line {block[0].number}", f"a second bone '{bone.name[:40]}'", "unique names", RESTORE)
        names.add(bone.name)
        yield bone


def _blocks(path: Path, lines: Sequence[Line]) -> Iterator[list[Line]]:
    """The lines between each `begin` and its `end`."""
    block: list[Line] | None = None
    for line in lines:
        word = line.words[0].lower()
        if word not in ("begin", "end"):
            if block is None:
                raise input_error(f"{path}: line {line.number}", f"'{' '.join(line.words)[:40]}' outside of begin and end", "begin", RESTORE)
            block.append(line)
        elif (word == "begin") != (block is None):
            raise input_error(f"{path}: line {line.number}", word, "'begin' and 'end' alternating", RESTORE)
        elif block is None:
            block = []
        else:
            if block:
                yield block
            block = None
    if block is not None:
        raise input_error(path, "cut off: a 'begin' without its 'end'", KIND, RESTORE)


def _bone(path: Path, block: list[Line], degrees: float) -> Bone:
    fields = _fields(path, block, {"name": 1, "direction": 3, "length": 1, "axis": 4})
    direction, length = (numbers(f"{path}: line {fields[key].number}", fields[key].words[1:]) for key in ("direction", "length"))
    entry, name = f"{path}: line {fields['length'].number}", fields["name"].words[1]
    norm = float(np.linalg.norm(direction))
    if not (length[0] >= 0 and (norm > 0 or length[0] == 0)):
        problem = f"bone '{name[:40]}' of length {length[0]:g} along {direction.tolist()}"
        raise input_error(entry, problem, "a length of at least 0 along a direction", RESTORE)
    angles = numbers(f"{path}: line {fields['axis'].number}", fields["axis"].words[1:4])
    dofs = tuple(word.lower() for word in fields["dof"].words[1:]) if "dof" in fields else ()
    if not set(dofs) <= {"rx", "ry", "rz"} or len(set(dofs)) < len(dofs):
        raise input_error(
            f"{path}: line {fields['dof'].number}", f"dof {' '.join(dofs)[:40]}", "rx, ry, rz, each at most once", "other dofs are not supported"
        )
    return Bone(name, direction * (length[0] / max(norm, 1e-300)), _axis(path, fields["axis"], degrees * angles), dofs)


def _hierarchy(path: Path, lines: Sequence[Line], bones: Mapping[str, Bone]) -> dict[str, str]:
    """The parent of each bone, parents before children; the root is its own parent."""
    children: dict[str, list[str]] = {}
    for block in _blocks(path, lines):
        for line in block:
            undeclared = [word for word in line.words if word not in bones]
            if undeclared:
                expected = f"the bones of :bonedata: {', '.join(bones)}"
                raise input_error(
                    f"{path}: line {line.number}", f"the hierarchy has a bone '{undeclared[0][:40]}' missing in :bonedata", expected, RESTORE
                )
            children.setdefault(line.words[0], []).extend(line.words[1:])
    return _parents(path, children, bones)


def _parents(path: Path, children: Mapping[str, list[str]], bones: Mapping[str, Bone]) -> dict[str, str]:
    parents, stack = {ROOT: ROOT}, [(child, ROOT) for child in reversed(children.get(ROOT, []))]
    while stack:
        name, parent = stack.pop()
        if name in parents:
            raise input_error(f"{path}: :hierarchy", f"the bone '{name}' twice", "each bone once", RESTORE)
        parents[name] = parent
        stack += [(child, name) for child in reversed(children.get(name, []))]
    if orphans := [name for name in bones if name not in parents]:
        raise input_error(f"{path}: :hierarchy", f"nothing leads from the root to {', '.join(orphans)[:200]}", "every bone of :bonedata", RESTORE)
    return parents
