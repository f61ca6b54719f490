r"""Generate walks of any length, speed and heading from a walking cycle, as landmarks.

The cycle gives the pose at a phase. Its segments are then scaled to their lengths, parents first. A standing foot moves as little as in the mean
stride, where its velocity is $u_i$ (a foot rolls): the pelvis moves with $\dot p = \sum_i w_i (u_i - \dot f_i) / \sum_i w_i$, where $f_i$ is a
point's position relative to it, and the weights decrease with $|u_i|$.
"""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.interpolate import CubicSpline

from bayes_body.base.errors import input_error
from bayes_body.workshop.learning.gait import TREE, WalkingCycle, load_cycle, terms

__all__ = ["WalkingCycle", "load_cycle", "walk"]

HEIGHT_M = 1.75
# Coefficients, in standard deviations between strides: the spread between walkers, the spread between a walker's strides, and the largest value.
BETWEEN, WITHIN, FARTHEST = 0.8, 0.25, 1.5
# A point of a foot that moves more slowly than this, heights/s, is standing.
STANDS = 0.12
FEET = tuple(f"{side}_{point}" for side in "lr" for point in ("ankle", "heel", "toe"))
# Number of samples of the mean stride from which weights are computed.
SAMPLES = 256


class _Feet(NamedTuple):
    """Points of the feet in the mean stride: the weight with which each stands, and its motion over the floor per phase, heights."""

    weights: Float[np.ndarray, "frame foot"]
    moves: Float[np.ndarray, "frame foot 2"]


class _Gait(NamedTuple):
    """A walk before its contact with the floor: the phase of every frame, and the cycle's columns at these phases, heights."""

    phase: Float[np.ndarray, " frame"]
    columns: Float[np.ndarray, "frame column"]


def walk(
    cycle: WalkingCycle,
    seconds: float,
    fps: float,
    speed: float = 1.0,
    coefficients: Sequence[float] = (),
    seed: int | None = None,
    heading: float = 0.0,
    start: tuple[float, float] = (0.0, 0.0),
    height_m: float = HEIGHT_M,
    phase: float = 0.0,
) -> dict[str, Float[np.ndarray, "frame 3"]]:
    """Generate a straight walk as landmarks by name, metres, z up, on a floor at 0.

    Args:
        cycle: the walking cycle.
        seconds: duration.
        fps: frames per second.
        speed: stride rate relative to the cycle.
        coefficients: coefficients of the cycle's modes, in standard deviations; missing ones are 0.
        seed: the seed of a random walker whose strides differ a little; None repeats the same stride.
        heading: direction, radians from the world's x towards y.
        start: position of the pelvis in the first frame, metres.
        height_m: the walker's height.
        phase: phase of the first frame; 0 is a strike of the left heel.

    Raises:
        InputError: a number is not finite, or not above 0.
    """
    _check({"seconds": seconds, "fps": fps, "speed": speed, "height_m": height_m}, coefficients, len(cycle.modes))
    gait = _gait(cycle, max(round(seconds * fps), 1), fps, speed, coefficients, seed, height_m, phase)
    bodies = _upright(cycle, gait.columns)
    pelvis = _travelled(cycle, gait, bodies)
    c, s = np.cos(heading), np.sin(heading)
    R = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    places = {name: height_m * (pelvis + track) @ R.T + (*start, 0.0) for name, track in bodies.items()}
    return {"pelvis": height_m * pelvis @ R.T + (*start, 0.0)} | places


def _check(numbers: Mapping[str, float], coefficients: Sequence[float], modes: int) -> None:
    for name, value in numbers.items():
        if not (np.isfinite(value) and value > 0):
            raise input_error(f"walk: {name}", f"{value:g}", "a finite number above 0", "correct it")
    if len(coefficients) > modes or not np.isfinite(coefficients).all():
        raise input_error(
            "walk: coefficients", str(list(coefficients)), f"at most {modes} finite numbers, one for each mode of the cycle", "correct them"
        )


def _gait(
    cycle: WalkingCycle, frames: int, fps: float, speed: float, coefficients: Sequence[float], seed: int | None, height_m: float, phase: float
) -> _Gait:
    base_coefficients = np.zeros(len(cycle.modes))
    base_coefficients[: len(coefficients)] = coefficients
    # For dynamically similar people, step times are proportional to the square root of height (Alexander 1989).
    tempo = speed / np.sqrt(height_m / cycle.height_m) / fps
    quickest = np.exp(-cycle.pace[0] + FARTHEST * np.abs(cycle.pace_modes[:, 0]).sum() + np.abs(base_coefficients @ cycle.pace_modes[:, 0]))
    course = _course(base_coefficients, seed, frames * tempo * quickest)
    phases = [phase]
    for _ in range(frames - 1):
        phases.append(phases[-1] + tempo * np.exp(-cycle.pace[0] - course(phases[-1] - phase) @ cycle.pace_modes[:, 0]))
    mode_coefficients = course(np.array(phases) - phase)
    series = terms(np.array(phases))
    columns = series @ cycle.mean + np.einsum("fm,ft,mtc->fc", mode_coefficients, series, cycle.modes)
    return _Gait(np.array(phases), columns)


def _course(coefficients: Float[np.ndarray, " mode"], seed: int | None, strides: float) -> CubicSpline:
    """The coefficients over the strides: a smooth curve, with different values in every stride."""
    count = int(strides) + 3
    drawn = np.zeros((count, coefficients.size))
    if seed is not None:
        rng = np.random.default_rng(seed)
        walker = np.clip(BETWEEN * rng.standard_normal(coefficients.size), -FARTHEST, FARTHEST)
        drawn = np.clip(walker + WITHIN * rng.standard_normal(drawn.shape), -FARTHEST, FARTHEST)
    return CubicSpline(np.arange(count), coefficients + drawn)


def _upright(cycle: WalkingCycle, columns: Float[np.ndarray, "frame column"]) -> dict[str, Float[np.ndarray, "frame 3"]]:
    """Positions relative to the pelvis, heights, with segments of constant length."""
    raw = {"pelvis": np.zeros((len(columns), 3))} | {name: columns[:, 3 * i : 3 * i + 3] for i, name in enumerate(cycle.names)}
    places = {"pelvis": raw["pelvis"]}
    for name, length in sorted(zip(cycle.names, cycle.segments, strict=True), key=lambda bone: _depth(bone[0])):
        segment = raw[name] - raw[TREE[name]]
        places[name] = places[TREE[name]] + length * segment / np.linalg.norm(segment, axis=1, keepdims=True)
    return {name: places[name] for name in cycle.names}


def _depth(name: str) -> int:
    return 1 + _depth(TREE[name]) if name in TREE else 0


def _travelled(cycle: WalkingCycle, gait: _Gait, bodies: Mapping[str, Float[np.ndarray, "frame 3"]]) -> Float[np.ndarray, "frame 3"]:
    """The path of the pelvis, heights: carried by the standing feet, at the cycle's height, from 0 along x."""
    middle = _feet(cycle, (gait.phase[1:] + gait.phase[:-1]) / 2)
    feet = np.stack([bodies[name] for name in cycle.names if name in FEET], axis=1)[..., :2]
    steps = middle.moves * np.diff(gait.phase)[:, None, None] - np.diff(feet, axis=0)
    steps = np.einsum("fi,fia->fa", middle.weights, steps) / middle.weights.sum(axis=1, keepdims=True)
    way = np.concatenate([np.zeros((1, 2)), np.cumsum(steps, axis=0)])
    # Sideways steps do not quite cancel; remove the drift so that the walk is straight on average.
    way[:, 1] -= np.linspace(0.0, way[-1, 1], len(way))
    return np.concatenate([way, gait.columns[:, -1:]], axis=1)


def _feet(cycle: WalkingCycle, phase: Float[np.ndarray, " frame"]) -> _Feet:
    """The feet of the mean stride at these phases."""
    grid = np.arange(SAMPLES) / SAMPLES
    columns = terms(grid) @ cycle.mean
    duration, length = np.exp(cycle.pace)
    pelvis = columns[:, -3:] + np.outer(grid, (length, 0.0, 0.0))
    feet = np.stack([pelvis + columns[:, 3 * i : 3 * i + 3] for i, name in enumerate(cycle.names) if name in FEET], axis=1)
    steps = np.roll(feet, -1, axis=0) - np.roll(feet, 1, axis=0)
    steps[[0, -1], :, 0] += length
    moves = steps * SAMPLES / 2
    speeds = np.linalg.norm(moves, axis=2) / duration
    # A small weight everywhere, so that the sum of weights is never 0.
    weights = np.exp(-((speeds / STANDS) ** 2)) + 1e-6
    return _Feet(_between(weights, phase), _between(moves[..., :2], phase))


def _between(samples: Float[np.ndarray, "sample *rest"], phase: Float[np.ndarray, " frame"]) -> Float[np.ndarray, "frame *rest"]:
    """Samples of a stride, interpolated linearly at these phases."""
    closed = np.concatenate([samples, samples[:1]])
    place = (phase % 1.0) * len(samples)
    lower = np.minimum(place.astype(int), len(samples) - 1)
    share = (place - lower).reshape(-1, *[1] * (samples.ndim - 1))
    return (1 - share) * closed[lower] + share * closed[lower + 1]
