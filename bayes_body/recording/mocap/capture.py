"""What a file holds, in its own unit and axes; and from there to metres with z up, by a turn and never by a mirror."""

import math
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from bayes_body.errors import InputError, input_error
from bayes_body.recording.mocap.motion import Motion

# Metres of one unit. `cmu`: what the skeletons of the CMU database count in, 1/0.45 inch; conversions of it to BVH keep it.
UNITS = {"m": 1.0, "cm": 0.01, "mm": 0.001, "in": 0.0254, "ft": 0.3048, "cmu": 0.0254 / 0.45}
AXES = ("x", "y", "z", "-x", "-y", "-z")
# From a child of two years to beyond the tallest man; loose markers may be those of one arm.
HEIGHTS_M = (0.8, 2.7)
EXTENTS_M = (0.2, 2.7)
# Toe to fingertips along the bones is the longest way through a skeleton: of it the height is this share (0.65 to 0.69 of the CMU set's people).
HEIGHT_OF_WAY = 0.67
# As of the positions of a session.
FARTHEST_M = 1000.0
# Frames whose vertical extent is measured.
SAMPLED = 500
FASTEST_FPS = 100_000.0


class Capture(NamedTuple):
    """A file's motion.

    Attributes:
        fps: frames a second, by what the file says or its kind's custom.
        joints: their names; of loose markers theirs.
        parents: as of `Motion`.
        positions: (frame, joint, 3), NaN where unknown.
        metres: of one unit, likewise.
        up: one of `AXES`, likewise.
        rotations: as of `Motion`, in the file's axes.
        way: the longest along the skeleton's bones from end to end; None of loose markers.
    """

    fps: float
    joints: tuple[str, ...]
    parents: tuple[int, ...]
    positions: Float[np.ndarray, "frame joint 3"]
    metres: float
    up: str
    rotations: Float[np.ndarray, "frame joint 3 3"] | None = None
    way: float | None = None


def to_motion(path: Path, capture: Capture, unit: str | float | None, up: str | None, fps: float | None) -> Motion:
    """The motion in metres, z up.

    Args:
        path: of the file.
        capture: what is in it.
        unit: a name of `UNITS`, or the metres of one unit; what the file says by default.
        up: one of `AXES`; what the file says by default.
        fps: frames a second; what the file says by default.

    Raises:
        InputError: an unknown unit or axis, a rate that is none, or a unit that makes nobody's height.
    """
    metres = capture.metres if unit is None else metres_of(unit)
    turn = to_z_up(capture.up if up is None else up)
    rate = capture.fps if fps is None else fps
    if not 0 < rate <= FASTEST_FPS:
        raise input_error(f"{path}: frames a second", f"{rate:g}", f"a number above 0, at most {FASTEST_FPS:g}", "give the right one as fps")
    _check_height(path, capture, metres, turn)
    positions = metres * capture.positions @ turn.T
    farthest = float(np.nanmax(np.abs(positions), initial=0.0))
    if farthest > FARTHEST_M:
        raise input_error(path, f"a position of {farthest:g} m", f"at most {FARTHEST_M:g} m", "correct the file, or give the right unit")
    rotations = None if capture.rotations is None else turn @ capture.rotations
    return Motion(path.stem, float(rate), capture.joints, capture.parents, positions, rotations)


def metres_of(unit: str | float) -> float:
    """The metres of a unit that a user gave by name or by number.

    Raises:
        InputError: no such unit.
    """
    metres = UNITS.get(unit, math.nan) if isinstance(unit, str) else float(unit)
    if not 0 < metres < math.inf:
        raise input_error("unit", str(unit), f"one of {', '.join(UNITS)}, or the metres of one unit", "name another")
    return metres


def to_z_up(up: str) -> Float[np.ndarray, "3 3"]:
    """The rotation that makes an axis point along z. The axes change places in turn, as `bayes-body export --up` has it.

    Raises:
        InputError: no such axis.
    """
    if up not in AXES:
        raise input_error("up", str(up), f"one of {', '.join(AXES)}", "name another")
    axis = "xyz".index(up[-1])
    turn = np.roll(np.eye(3), 2 - axis, axis=0)
    # Half a turn about x before: y and z point the other way, and nothing is mirrored.
    return np.diag([1.0, -1.0, -1.0]) @ turn if up.startswith("-") else turn


def known_unit(where: str, name: str) -> float:
    """The metres of the unit that a file names, such as `mm` or `Meters`.

    Raises:
        InputError: no such unit.
    """
    spelled = {"millimeter": "mm", "centimeter": "cm", "meter": "m", "inch": "in", "inche": "in", "feet": "ft", "foot": "ft"}
    word = name.strip().lower().replace("metre", "meter")
    found = next((unit for unit in (word, spelled.get(word.rstrip("s"), "")) if unit in UNITS), None)
    if found is None:
        raise input_error(where, f"'{name.strip()[:40]}'", f"one of {', '.join(UNITS)}", "correct it, or give the unit")
    return UNITS[found]


def _check_height(path: Path, capture: Capture, metres: float, turn: Float[np.ndarray, "3 3"]) -> None:
    height, bounds = _extent(capture.positions @ turn.T), EXTENTS_M
    if capture.way is not None:
        # Who lies down has a skeleton all the same.
        height, bounds = max(height, HEIGHT_OF_WAY * capture.way), HEIGHTS_M
    if height and not bounds[0] <= height * metres <= bounds[1]:
        raise _no_height(path, height, metres, bounds)


def _extent(positions: Float[np.ndarray, "frame joint 3"]) -> float:
    """From the lowest joint to the highest while upright: in one frame of twenty it is more. 0 where no two are known."""
    heights = positions[:: max(len(positions) // SAMPLED, 1), :, 2]
    seen = heights[~np.isnan(heights).all(axis=1)]
    return float(np.percentile(np.nanmax(seen, axis=1) - np.nanmin(seen, axis=1), 95)) if len(seen) else 0.0


def _no_height(path: Path, height: float, metres: float, bounds: tuple[float, float]) -> InputError:
    # The unit that makes the likeliest height, if any makes a person.
    fitting = {unit: height * m for unit, m in UNITS.items() if HEIGHTS_M[0] <= height * m <= HEIGHTS_M[1]}
    best = min(fitting, key=lambda unit: abs(fitting[unit] - 1.7), default=None)
    remedy = f"give the unit: '{best}' would make {fitting[best]:.2f} m" if best else "give the unit, or correct the file"
    name = next((unit for unit, m in UNITS.items() if math.isclose(m, metres)), f"{metres:g} m")
    return input_error(path, f"a person {_length(height * metres)} tall, in the unit '{name}'", f"{bounds[0]:g} to {bounds[1]:g} m", remedy)


def _length(metres: float) -> str:
    return f"{metres:.4g} m" if metres >= 1 else f"{100 * metres:.3g} cm" if metres >= 0.01 else f"{1000 * metres:.3g} mm"
