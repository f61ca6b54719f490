"""AMC, the motion of an Acclaim skeleton: for each frame one line per bone, with the values of its dofs in the order of the skeleton's file."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float

from bayes_body.base.errors import InputError, input_error
from bayes_body.recording.readers.mocap.asf import ROOT, Bone, Skeleton, read_asf
from bayes_body.recording.readers.mocap.capture import Capture
from bayes_body.recording.readers.mocap.text import read_text, table
from bayes_body.recording.readers.mocap.tree import longest_path, place, turns

KIND = "an AMC motion (a frame number, then a line for each bone)"
RESTORE = "restore the file, or give the skeleton file that belongs to it"
# The file does not state it; the CMU database was recorded at 120.
USUAL_FPS = 120.0
# Suffix for the end of a limb's last bone.
END = "_end"


def read_amc(path: Path, skeleton: Path | None = None) -> Capture:
    """A motion and its skeleton. A joint is where its bone starts; `NAME_end` is the end of a limb's last bone.

    Args:
        path: the .amc.
        skeleton: the .asf. Default: the one beside the motion with its number (`02_01.amc`: `02.asf`), or the only one there.

    Raises:
        InputError: a file cannot be read or has another format; there is no .asf; one of the files lacks a bone; a frame lacks values; the frame
            numbers are not consecutive.
    """
    text = read_text(path, KIND)
    bones = read_asf(skeleton or find_asf(path))
    values, degrees = _values(path, text, bones)
    return Capture(fps=USUAL_FPS, up="y", metres=bones.metres, **_placed(bones, values, degrees))


def find_asf(path: Path) -> Path:
    """The skeleton file beside a motion file.

    Raises:
        InputError: there is none, or there are several and none has the motion's number.
    """
    try:
        files = sorted(file for file in path.parent.iterdir() if file.suffix.lower() == ".asf")
    except OSError as error:
        raise input_error(path.parent, f"cannot be read ({error.strerror})", "the folder of an .asf", "give the skeleton file") from None
    same_number = [file for file in files if file.stem in (path.stem, path.stem.rpartition("_")[0])]
    if len(same_number or files) != 1:
        problem = f"{len(files)} .asf beside it ({', '.join(file.name for file in files[:10])})" if files else "no .asf beside it"
        named = f"{path.stem.rpartition('_')[0] or path.stem}.asf, or one .asf in the folder"
        raise input_error(path, problem, named, "put the skeleton's file there, or give it as skeleton")
    return (same_number or files)[0]


def _placed(skeleton: Skeleton, values: Mapping[str, Float[np.ndarray, "frame dof"]], degrees: float) -> dict:
    bones, parents = list(skeleton.bones), list(skeleton.parents)
    frames = len(values[ROOT])
    local = [_turned(bone, values.get(bone.name, np.zeros((frames, 0))), degrees) for bone in bones]
    offsets = [np.zeros(3) if parent < 0 else bones[parent].offset for parent in parents]
    names = [bone.name for bone in bones]
    for j in sorted(set(range(1, len(bones))) - set(parents)):
        names.append(f"{names[j]}{END}")
        parents.append(j)
        offsets.append(bones[j].offset)
        local.append(np.broadcast_to(np.eye(3), (frames, 3, 3)))
    rest_offsets = np.array(offsets)
    moved = np.repeat(rest_offsets[None], frames, axis=0)
    shifts = [bones[0].dofs.index(dof) for dof in ("tx", "ty", "tz")]
    moved[:, 0] = skeleton.position + values[ROOT][:, shifts]
    positions, rotations = place(parents, moved, np.stack(local, axis=1))
    longest = longest_path(parents, rest_offsets)
    return {"joints": tuple(names), "parents": tuple(parents), "positions": positions, "rotations": rotations, "longest_path": longest}


def _turned(bone: Bone, values: Float[np.ndarray, "frame dof"], degrees: float) -> Float[np.ndarray, "frame 3 3"]:
    """L = C M C⁻¹. For the root it is C M, because the root's C also rotates its children at rest."""
    turning = [k for k, dof in enumerate(bone.dofs) if dof[0] == "r"]
    M = turns("".join(bone.dofs[k][1] for k in turning), degrees * values[:, turning])
    return bone.axis @ M if bone.name == ROOT else bone.axis @ M @ bone.axis.T


def _values(path: Path, text: str, skeleton: Skeleton) -> tuple[dict[str, Float[np.ndarray, "frame dof"]], float]:
    """The dofs' values by bone, and the degrees per unit of angle."""
    wanted = {bone.name: len(bone.dofs) for bone in skeleton.bones if bone.dofs}
    reading = _Reading(path, wanted)
    degrees = skeleton.degrees
    for number, line in enumerate(text.splitlines(), 1):
        words = line.split()
        if not words or words[0][0] == "#":
            continue
        if words[0][0] == ":":
            degrees = {":DEGREES": 1.0, ":RADIANS": float(np.degrees(1))}.get(words[0].upper(), degrees)
        elif len(words) == 1:
            reading.frame(number, words[0])
        else:
            reading.bone(number, words)
    reading.end()
    return {name: table(str(path), rows, reading.lines[name]) for name, rows in reading.rows.items()}, degrees


class _Reading:
    """The rows of each bone so far. An incomplete frame raises an error where it ends."""

    def __init__(self, path: Path, wanted: Mapping[str, int]):
        self.path, self.wanted = path, wanted
        self.rows: dict[str, list[list[str]]] = {name: [] for name in wanted}
        self.lines: dict[str, list[int]] = {name: [] for name in wanted}
        self.frames, self.label = 0, 0

    def frame(self, line: int, word: str) -> None:
        """Begin the frame with that number."""
        if not (word.isascii() and word.isdigit() and len(word) < 10):
            raise self._error(line, f"'{word[:40]}'", "a frame number, or a bone and its values")
        if self.frames and int(word) != self.label + 1:
            raise self._error(line, f"frame {int(word)} after frame {self.label}", "consecutive frame numbers")
        self._check_complete()
        self.frames, self.label = self.frames + 1, int(word)

    def bone(self, line: int, words: Sequence[str]) -> None:
        """Add a bone's values to the frame."""
        name, count = words[0], len(words) - 1
        if name not in self.wanted:
            raise self._error(line, f"the bone '{name[:40]}'", f"a moving bone of the skeleton: {', '.join(self.wanted)}")
        if count != self.wanted[name]:
            raise self._error(line, f"{count} values of the bone '{name}' in frame {self.label}", f"{self.wanted[name]}, its dofs in the skeleton")
        if len(self.rows[name]) != self.frames - 1:
            problem = "values before the first frame number" if not self.frames else f"the bone '{name}' twice in frame {self.label}"
            raise self._error(line, problem, KIND)
        self.rows[name].append(list(words[1:]))
        self.lines[name].append(line)

    def end(self) -> None:
        """Finish after the last line."""
        if not self.frames:
            raise input_error(self.path, "no frame", KIND, "name another file, or restore this one")
        self._check_complete()

    def _check_complete(self) -> None:
        missing = [name for name, rows in self.rows.items() if len(rows) < self.frames]
        if missing:
            raise input_error(self.path, f"frame {self.label} has no values of {', '.join(missing)}", "every moving bone of the skeleton", RESTORE)

    def _error(self, line: int, problem: str, expected: str) -> InputError:
        return input_error(f"{self.path}: line {line}", problem, expected, RESTORE)
