"""BVH (Biovision): a hierarchy of joints with offsets, then one row of channels per frame.

Channels come in any order and rotate about the joint's own axes in sequence: Zrotation Xrotation Yrotation is $R_z R_x R_y$. Position channels
replace the offset, axis by axis, as in Blender. The default unit is centimetres.
"""

from collections.abc import Iterator
from itertools import islice
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from bayes_body.base.errors import InputError, input_error
from bayes_body.recording.readers.mocap.capture import UNITS, Capture
from bayes_body.recording.readers.mocap.text import numbers, read_text, table
from bayes_body.recording.readers.mocap.tree import longest_path, place, turns

KIND = "a BVH file (HIERARCHY, MOTION)"
RESTORE = "restore the file"
CHANNELS = {f"{axis}{kind}": (kind, axis.lower()) for axis in "XYZ" for kind in ("position", "rotation")}
# Suffix for a joint's End Site.
END = "_end"
# Frame times have few digits: 0.00833 s means 120 frames per second.
WHOLE_FPS = 5e-4


class Joint(NamedTuple):
    """A joint, or the end of a limb's last joint, which has no channels.

    Attributes:
        name: the name in the file; `PARENT_end` for an End Site.
        parent: its index; -1 for the root.
        offset: from the parent, in the file's unit.
        channels: pairs of `position` or `rotation`, and the axis.
    """

    name: str
    parent: int
    offset: Float[np.ndarray, "3"]
    channels: tuple[tuple[str, str], ...]


class Word(NamedTuple):
    """A word and its line number."""

    line: int
    text: str


def read_bvh(path: Path) -> Capture:
    """Read a motion.

    Raises:
        InputError: the file cannot be read, has another format, or is cut off: in the hierarchy, in a row, or before the last frame that it declares.
    """
    text = read_text(path, KIND)
    lines = text.splitlines()
    start = next((number for number, line in enumerate(lines) if line.strip().upper() == "MOTION"), None)
    joints = _joints(path, lines[:start])
    if start is None:
        raise input_error(path, f"cut off: {len(joints)} joints, and no MOTION", KIND, RESTORE)
    fps, values = _motion(path, lines, start + 1, sum(len(joint.channels) for joint in joints))
    parents = tuple(joint.parent for joint in joints)
    offsets, local = _channels(joints, values)
    positions, rotations = place(parents, offsets, local)
    longest = longest_path(parents, np.array([joint.offset for joint in joints]))
    return Capture(fps, tuple(joint.name for joint in joints), parents, positions, UNITS["cm"], "y", rotations, longest)


def _joints(path: Path, lines: list[str]) -> list[Joint]:
    words = iter([Word(number, text) for number, line in enumerate(lines, 1) for text in line.replace("{", " { ").replace("}", " } ").split()])
    if next(words, Word(1, "")).text.upper() != "HIERARCHY":
        raise input_error(f"{path}: line 1", f"'{lines[0].strip()[:40] if lines else ''}'", KIND, "name another file")
    joints: list[Joint] = []
    # Indices of the joints whose braces are still open.
    open_joints: list[int] = []
    for word in words:
        kind = word.text.upper()
        if kind == "}" and open_joints:
            open_joints.pop()
        elif (kind == "ROOT" and not joints) or (kind in ("JOINT", "END") and open_joints and not joints[open_joints[-1]].name.endswith(END)):
            joints.append(_joint(path, kind, words, joints, open_joints[-1] if open_joints else -1))
            open_joints.append(len(joints) - 1)
        else:
            raise _unexpected(path, word, "JOINT, End Site or }" if joints else "ROOT")
    if open_joints or not joints:
        end = f"in '{joints[open_joints[-1]].name}'" if joints else "before the first joint"
        raise input_error(f"{path}: line {len(lines)}", f"cut off in the hierarchy, {end}", "a closing brace for each joint", RESTORE)
    return joints


def _joint(path: Path, kind: str, words: Iterator[Word], joints: list[Joint], parent: int) -> Joint:
    """Read name, offset and channels, after the keyword."""
    name = "_".join(word.text for word in _until(path, words, "{"))
    name = f"{joints[parent].name}{END}" if kind == "END" else name
    if not name or any(joint.name == name for joint in joints):
        raise input_error(path, f"a second joint '{name[:40]}'" if name else "a joint without a name", "unique names", "rename it")
    offset = channels = None
    while offset is None or (channels is None and kind != "END"):
        word = next(words, None)
        if word is not None and word.text.upper() == "OFFSET" and offset is None:
            offset = numbers(f"{path}: line {word.line}: OFFSET of '{name[:40]}'", [w.text for w in _take(path, words, 3)], RESTORE)
        elif word is not None and word.text.upper() == "CHANNELS" and channels is None and kind != "END":
            channels = _named_channels(path, words)
        else:
            raise _unexpected(path, word, f"OFFSET{'' if kind == 'END' else ' and CHANNELS'} of '{name[:40]}'")
    return Joint(name, parent, offset, channels or ())


def _named_channels(path: Path, words: Iterator[Word]) -> tuple[tuple[str, str], ...]:
    count = _take(path, words, 1)[0]
    if count.text not in [str(number) for number in range(len(CHANNELS) + 1)]:
        raise _unexpected(path, count, f"the number of channels, at most {len(CHANNELS)}")
    spelled = {name.lower(): channel for name, channel in CHANNELS.items()}
    out = []
    for word in _take(path, words, int(count.text)):
        channel = spelled.get(word.text.lower())
        if channel is None or channel in out:
            raise _unexpected(path, word, f"each of {', '.join(CHANNELS)} at most once")
        out.append(channel)
    return tuple(out)


def _take(path: Path, words: Iterator[Word], count: int) -> list[Word]:
    out = list(islice(words, count))
    if len(out) < count:
        raise _unexpected(path, None, f"{count} words")
    return out


def _until(path: Path, words: Iterator[Word], mark: str) -> list[Word]:
    out = []
    for word in words:
        if word.text == mark:
            return out
        out.append(word)
    raise _unexpected(path, None, f"'{mark}'")


def _unexpected(path: Path, word: Word | None, expected: str) -> InputError:
    if word is None:
        return input_error(path, "cut off in the hierarchy", expected, RESTORE)
    return input_error(f"{path}: line {word.line}", f"'{word.text[:40]}' in the hierarchy", expected, RESTORE)


def _motion(path: Path, lines: list[str], start: int, width: int) -> tuple[float, Float[np.ndarray, "frame channel"]]:
    """Frames per second, and the rows."""
    filled = [(number, line.split()) for number, line in enumerate(lines[start:], start + 1) if line.strip()]
    frames = _headed(path, filled[:1], "Frames:")
    seconds = _headed(path, filled[1:2], "Frame Time:")
    rows = filled[2:]
    if not (frames >= 1 and frames == int(frames) and seconds > 1e-6):
        raise input_error(path, f"{frames:g} frames of {seconds:g} s each", "one or more, each longer than 0", RESTORE)
    if len(rows) != frames:
        cut = "cut off: " if len(rows) < frames else ""
        raise input_error(path, f"{cut}{len(rows)} frames where 'Frames:' says {frames:.0f}", "the same number", f"{RESTORE}, or correct 'Frames:'")
    for number, row in rows:
        if len(row) != width:
            raise input_error(f"{path}: line {number}", f"{len(row)} values", f"{width}, the channels of the hierarchy", RESTORE)
    values = table(str(path), [row for _, row in rows], [number for number, _ in rows])
    fps = 1 / seconds
    return float(round(fps)) if abs(fps - round(fps)) < WHOLE_FPS * fps else fps, values


def _headed(path: Path, line: list[tuple[int, list[str]]], head: str) -> float:
    """The number after a heading such as `Frame Time:`."""
    words = head.split()
    if not line:
        raise input_error(path, f"cut off: no '{head}'", f"{KIND}, with '{head}' and a number", RESTORE)
    number, tokens = line[0]
    # `Frames:30` is one word.
    text = " ".join(tokens).replace(":", ": ").split()
    if [word.lower() for word in text[:-1]] != [word.lower() for word in words]:
        raise input_error(f"{path}: line {number}", f"'{' '.join(tokens)[:40]}'", f"'{head}' and a number", RESTORE)
    return float(numbers(f"{path}: line {number}", text[-1:], RESTORE)[0])


def _channels(
    joints: list[Joint], values: Float[np.ndarray, "frame channel"]
) -> tuple[Float[np.ndarray, "frame joint 3"], Float[np.ndarray, "frame joint 3 3"]]:
    """Offsets and rotations of each joint relative to its parent, in each frame."""
    offsets = np.repeat(np.array([joint.offset for joint in joints])[None], len(values), axis=0)
    local = np.empty((*offsets.shape, 3))
    first = 0
    for j, joint in enumerate(joints):
        columns = values[:, first : first + len(joint.channels)]
        first += len(joint.channels)
        turning = [k for k, (kind, _) in enumerate(joint.channels) if kind == "rotation"]
        # Rotations about the joint's own axes in the given order equal rotations about fixed axes in the reverse order.
        local[:, j] = turns("".join(joint.channels[k][1] for k in turning[::-1]), columns[:, turning[::-1]])
        for k, (kind, axis) in enumerate(joint.channels):
            if kind == "position":
                offsets[:, j, "xyz".index(axis)] = columns[:, k]
    return offsets, local
