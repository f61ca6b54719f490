"""The content of a file in its unit and axes, and its conversion to metres with z up, by a rotation and never a reflection."""

import math
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from bayes_body.base.errors import InputError, input_error
from bayes_body.recording.readers.mocap.motion import Motion

# Metres per unit. `cmu`: the unit of the CMU database's skeletons, 1/0.45 inch; conversions of it to BVH keep it.
UNITS = {"m": 1.0, "cm": 0.01, "mm": 0.001, "in": 0.0254, "ft": 0.3048, "cmu": 0.0254 / 0.45}
AXES = ("x", "y", "z", "-x", "-y", "-z")
# From a child of two years to more than the tallest person. Loose markers may cover only one arm.
HEIGHTS_M = (0.8, 2.7)
EXTENTS_M = (0.2, 2.7)
# Height divided by the longest path through a skeleton, along the bones from toe to fingertips (0.65 to 0.69 for the people of the CMU set).
HEIGHT_OF_PATH = 0.67
# As for the positions of a session.
FARTHEST_M = 1000.0
# Number of frames in which the vertical extent is measured.
SAMPLED = 500
FASTEST_FPS = 100_000.0


class Capture(NamedTuple):
    """The motion in a file.

    Attributes:
        fps: frames per second, as the file states or its format implies.
        joints: the names of the joints, or of loose markers.
        parents: as in `Motion`.
        positions: (frame, joint, 3), NaN where unknown.
        metres: metres per unit of length, as the file states or its format implies.
        up: one of `AXES`, as the file states or its format implies.
        rotations: as in `Motion`, in the file's axes.
        longest_path: the longest path along the skeleton's bones from end to end; None for loose markers.
    """

    fps: float
    joints: tuple[str, ...]
    parents: tuple[int, ...]
    positions: Float[np.ndarray, "frame joint 3"]
    metres: float
    up: str
    rotations: Float[np.ndarray, "frame joint 3 3"] | None = None
    longest_path: float | None = None


def to_motion(path: Path, capture: Capture, unit: str | float | None, up: str | None, fps: float | None) -> Motion:
    """The motion in metres, z up.

    Args:
        path: the file.
        capture: its content.
        unit: a name in `UNITS`, or metres per unit; default: the file's unit.
        up: one of `AXES`; default: the file's.
        fps: frames per second; default: the file's rate.

    Raises:
        InputError: an unknown unit or axis, an invalid rate, or a unit that gives no human height.
    """
    metres = capture.metres if unit is None else metres_of(unit)
    turn = to_z_up(capture.up if up is None else up)
    rate = capture.fps if fps is None else fps
    if not 0 < rate <= FASTEST_FPS:
        raise input_error(f"{path}: frames per second", f"{rate:g}", f"a number above 0, at most {FASTEST_FPS:g}", "give the right rate as fps")
    _check_height(path, capture, metres, turn)
    positions = metres * capture.positions @ turn.T
    farthest = float(np.nanmax(np.abs(positions), initial=0.0))
    if farthest > FARTHEST_M:
        raise input_error(path, f"a position of {farthest:g} m", f"at most {FARTHEST_M:g} m", "correct the file, or give the right unit")
    rotations = None if capture.rotations is None else turn @ capture.rotations
    return Motion(path.stem, float(rate), capture.joints, capture.parents, positions, rotations)


def metres_of(unit: str | float) -> float:
    """Metres per unit, for a unit given by name or by number.

    Raises:
        InputError: no such unit.
    """
    metres = UNITS.get(unit, math.nan) if isinstance(unit, str) else float(unit)
    if not 0 < metres < math.inf:
        raise input_error("unit", str(unit), f"one of {', '.join(UNITS)}, or the metres of one unit", "choose one of these")
    return metres


def to_z_up(up: str) -> Float[np.ndarray, "3 3"]:
    """The rotation that makes an axis point along z. It permutes the axes cyclically, like `bayes-body export --up`.

    Raises:
        InputError: no such axis.
    """
    if up not in AXES:
        raise input_error("up", str(up), f"one of {', '.join(AXES)}", "choose one of these")
    axis = "xyz".index(up[-1])
    turn = np.roll(np.eye(3), 2 - axis, axis=0)
    # First half a turn about x: it reverses y and z without a reflection.
    return np.diag([1.0, -1.0, -1.0]) @ turn if up.startswith("-") else turn


def known_unit(entry: str, name: str) -> float:
    """Metres per unit, for the unit that a file names, such as `mm` or `Meters`.

    Raises:
        InputError: no such unit.
    """
    spelled = {"millimeter": "mm", "centimeter": "cm", "meter": "m", "inch": "in", "inche": "in", "feet": "ft", "foot": "ft"}
    word = name.strip().lower().replace("metre", "meter")
    unit = next((unit for unit in (word, spelled.get(word.rstrip("s"), "")) if unit in UNITS), None)
    if unit is None:
        raise input_error(entry, f"'{name.strip()[:40]}'", f"one of {', '.join(UNITS)}", "correct it, or give the unit")
    return UNITS[unit]


def _check_height(path: Path, capture: Capture, metres: float, turn: Float[np.ndarray, "3 3"]) -> None:
    height, bounds = _extent(capture.positions @ turn.T), EXTENTS_M
    if capture.longest_path is not None:
        # Take the skeleton's length, because a person who lies down has no vertical extent.
        height, bounds = max(height, HEIGHT_OF_PATH * capture.longest_path), HEIGHTS_M
    if height and not bounds[0] <= height * metres <= bounds[1]:
        raise _no_height(path, height, metres, bounds)


def _extent(positions: Float[np.ndarray, "frame joint 3"]) -> float:
    """Height from the lowest to the highest joint while upright: the 95th percentile over frames. 0 if no two joints are known."""
    heights = positions[:: max(len(positions) // SAMPLED, 1), :, 2]
    heights_of_frames = heights[~np.isnan(heights).all(axis=1)]
    return float(np.percentile(np.nanmax(heights_of_frames, axis=1) - np.nanmin(heights_of_frames, axis=1), 95)) if len(heights_of_frames) else 0.0


def _no_height(path: Path, height: float, metres: float, bounds: tuple[float, float]) -> InputError:
    # Suggest the unit that gives the most plausible height, if any gives one.
    fitting = {unit: height * m for unit, m in UNITS.items() if HEIGHTS_M[0] <= height * m <= HEIGHTS_M[1]}
    best = min(fitting, key=lambda unit: abs(fitting[unit] - 1.7), default=None)
    remedy = f"give the unit: '{best}' would make {fitting[best]:.2f} m" if best else "give the unit, or correct the file"
    name = next((unit for unit, m in UNITS.items() if math.isclose(m, metres)), f"{metres:g} m")
    return input_error(path, f"a person {_length(height * metres)} tall, in the unit '{name}'", f"{bounds[0]:g} to {bounds[1]:g} m", remedy)


def _length(metres: float) -> str:
    return f"{metres:.4g} m" if metres >= 1 else f"{100 * metres:.3g} cm" if metres >= 0.01 else f"{1000 * metres:.3g} mm"
