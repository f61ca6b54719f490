"""Read a motion in any of the four formats, chosen by the file's suffix: amc (with its asf), bvh, c3d, trc."""

from collections.abc import Callable
from pathlib import Path

import numpy as np

from bayes_body.base.errors import input_error
from bayes_body.recording.readers.mocap.amc import read_amc
from bayes_body.recording.readers.mocap.bvh import read_bvh
from bayes_body.recording.readers.mocap.c3d import read_c3d
from bayes_body.recording.readers.mocap.capture import Capture, to_motion
from bayes_body.recording.readers.mocap.landmarks import best_reading
from bayes_body.recording.readers.mocap.motion import Motion
from bayes_body.recording.readers.mocap.trc import read_trc

READERS: dict[str, Callable[[Path], Capture]] = {".amc": read_amc, ".bvh": read_bvh, ".c3d": read_c3d, ".trc": read_trc}
# Formats that do not state the up axis, and whose files differ in it.
SILENT = (".bvh", ".trc")
# Largest component of the unit vector from feet to head along the other axes.
CLEARLY = 2.0


def read_motion(
    path: Path | str,
    skeleton: Path | str | None = None,
    unit: str | float | None = None,
    up: str | None = None,
    fps: float | None = None,
) -> Motion:
    """Read a captured motion in metres, z up.

    By default the unit is the file's (c3d, trc, asf) or the usual one (bvh: cm). It must give a human height. By default the up axis is the file's
    (c3d), y (asf), or the axis along which the head is above the feet (bvh, trc; y if this is unclear or the names are unknown). The world is rotated
    and never reflected: with y up, (x, y, z) becomes (z, x, y).

    Args:
        path: an .amc, .bvh, .c3d or .trc.
        skeleton: the .asf of an .amc; default: the one found beside it.
        unit: `m`, `cm`, `mm`, `in`, `ft` or `cmu`, or metres per unit.
        up: the file's axis that points up: `x`, `y`, `z`, `-x`, `-y` or `-z`.
        fps: frames per second, if the file's rate is wrong or missing (amc: 120).

    Raises:
        InputError: another suffix, a file that its reader refuses, or a unit that makes the person 2 cm or 200 m tall.
    """
    path, kind = Path(path), Path(path).suffix.lower()
    if kind == ".asf":
        raise input_error(path, "a skeleton without a motion", "an .amc", "name the motion; its skeleton is found beside it or given as skeleton")
    if kind not in READERS:
        raise input_error(path, f"the suffix '{kind}'", f"one of {', '.join(READERS)}", "name a file of motion capture")
    if skeleton is not None and kind != ".amc":
        raise input_error(path, "a skeleton is given with it", "a skeleton only with an .amc", "leave the skeleton out")
    capture = READERS[kind](path) if skeleton is None else read_amc(path, Path(skeleton))
    return to_motion(path, capture, unit, _upward(capture) if up is None and kind in SILENT else up, fps)


def _upward(capture: Capture) -> str | None:
    """The axis along which the head is above the feet, if the direction is clear and the joint names are known."""
    joints = best_reading(capture.joints).joints
    if not {"head", "l_ankle", "r_ankle"} <= joints.keys():
        return None
    head, left_ankle, right_ankle = (capture.positions[:, capture.joints.index(joints[name])] for name in ("head", "l_ankle", "r_ankle"))
    ways = head - (left_ankle + right_ankle) / 2
    ways = ways[~np.isnan(ways).any(axis=-1)]
    if not len(ways):
        return None
    way = ways.mean(axis=0)
    axis = int(np.abs(way).argmax())
    if not abs(way[axis]) > CLEARLY * np.abs(np.delete(way, axis)).max():
        return None
    return f"{'-' if way[axis] < 0 else ''}{'xyz'[axis]}"
