r"""Strides as numbers that fit any person, and a walking cycle: a walker's mean stride and the main modes of variation between strides.

A stride is a Fourier series of the landmarks relative to the pelvis, along the walking direction, in body heights:
$x(\varphi) = a_0 + \sum_{k=1}^{8} a_k \cos 2\pi k\varphi + b_k \sin 2\pi k\varphi$, with the phase $\varphi$ from one strike of the left heel (0) to
the next (1). A strike is when the ankle is farthest in front of the pelvis (Zeni et al. 2008, Two simple methods for determining gait events). A
stride of the right foot is the mirrored stride of a left one, so every walk counts twice.

The walking cycle is $x = \bar x + \sum_k c_k m_k$ with $c_k \sim N(0, 1)$. Its modes are the first singular vectors of the centred strides, enough to
explain 95 % of the variance.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from scipy.signal import find_peaks

from bayes_body.base.errors import input_error
from bayes_body.base.files.arrays_file import read_arrays
from bayes_body.base.files.atomic import replacing
from bayes_body.base.files.shipped import definitions_folder

HARMONICS = 8
TERMS = 2 * HARMONICS + 1
# Strides take from 0.6 s (fast) to 2 s (slow). In a step the ankle passes the pelvis by more than this, heights.
SHORTEST_S, PROMINENCE = 0.6, 0.08
# Squared speed over gravity and leg length: people run above 0.5 (Kram et al. 1997).
GRAVITY, RUN = 9.81, 0.5
# The height of a standing ankle is this percentile over the frames.
STANDING = 10

# Each point and its parent: segments keep their lengths.
TREE = {
    "thorax": "pelvis",
    "neck": "thorax",
    "head": "thorax",
    **{f"{side}_{end}": f"{side}_{base}" for side in "lr" for end, base in (("knee", "hip"), ("ankle", "knee"), ("toe", "ankle"), ("heel", "ankle"))},
    **{f"{side}_{end}": f"{side}_{base}" for side in "lr" for end, base in (("elbow", "shoulder"), ("wrist", "elbow"), ("hand", "wrist"))},
    **{f"{side}_hip": "pelvis" for side in "lr"},
    **{f"{side}_shoulder": "thorax" for side in "lr"},
}

# These are required for a stride.
NEEDED = ("thorax", "head", *(f"{side}_{joint}" for side in "lr" for joint in ("hip", "knee", "ankle")))

type Points = Mapping[str, Float[np.ndarray, "frame 3"]]


class Stride(NamedTuple):
    """A stride of a person, in units of the person's height.

    Attributes:
        series: Fourier terms of x (forward), y (left) and z (up): of every point relative to the pelvis, then of the pelvis relative to steady
            motion.
        pace: logarithms of the duration, s, and of the length, heights.
    """

    series: Float[np.ndarray, "term column"]
    pace: Float[np.ndarray, "2"]


def points_of(landmarks: Points) -> tuple[str, ...]:
    """The points of a stride: those that have a parent and are known in every frame, in the order of `TREE`."""
    complete_points = {name for name, track in landmarks.items() if np.isfinite(track).all()}

    def has_parent(name: str) -> bool:
        return name in complete_points and (name not in TREE or has_parent(TREE[name]))

    return tuple(name for name in TREE if has_parent(name))


def segments(landmarks: Points, names: tuple[str, ...]) -> Float[np.ndarray, " point"]:
    """The mean distance of each point from its parent, metres; equal for left and right."""
    lengths = {name: float(np.linalg.norm(landmarks[name] - landmarks[TREE[name]], axis=1).mean()) for name in names}
    return np.array([np.mean([lengths[point] for point in (name, _mirrored(name)) if point in lengths]) for name in names])


def height(landmarks: Points, names: tuple[str, ...]) -> float:
    """The person's height, metres: the sum of the segments from the floor to the crown."""
    length = dict(zip(names, segments(landmarks, names), strict=True))
    ankle = float(np.mean([np.percentile(landmarks[f"{side}_ankle"][:, 2], STANDING) for side in "lr"]))
    return float(ankle + sum(length[name] for name in ("l_knee", "l_ankle", "thorax", "head")))


def speed(landmarks: Points, fps: float) -> float:
    """The mean speed over the floor in the whole recording, m/s."""
    way = landmarks["pelvis"][-1, :2] - landmarks["pelvis"][0, :2]
    return float(np.linalg.norm(way)) * fps / max(len(landmarks["pelvis"]) - 1, 1)


def is_run(landmarks: Points, fps: float) -> bool:
    """Whether people of this build run at this speed."""
    return bool(speed(landmarks, fps) ** 2 > RUN * GRAVITY * leg_length(landmarks))


def fault_of_walk(name: str, landmarks: Points, fps: float) -> str | None:
    """Return why captured landmarks are not used as a walk, or None."""
    if not set(NEEDED) <= set(points_of(landmarks)):
        return f"{name}: points unknown in some frames: left out"
    if is_run(landmarks, fps):
        return f"{name}: {speed(landmarks, fps):.1f} m/s is a run: left out"
    return None


def leg_length(landmarks: Points) -> float:
    """The length of thigh and shank together, metres; mean of both legs."""
    names = points_of(landmarks)
    length = dict(zip(names, segments(landmarks, names), strict=True))
    return float(length["l_knee"] + length["l_ankle"])


def heel_strikes(landmarks: Points, fps: float, height_m: float, side: str = "l") -> Int[np.ndarray, " strike"]:
    """The frames in which the heel of one side strikes the floor in a straight walk."""
    ankle_lead = (_align_with_x(landmarks)[f"{side}_ankle"] - _align_with_x(landmarks)["pelvis"])[:, 0] / height_m
    return find_peaks(ankle_lead, distance=max(int(SHORTEST_S * fps), 1), prominence=PROMINENCE)[0]


def strides(landmarks: Points, names: tuple[str, ...], fps: float, height_m: float) -> list[Stride]:
    """The strides of a straight walk: those of the left foot unchanged, those of the right foot mirrored."""
    aligned = _align_with_x(landmarks)
    mirrored = {_mirrored(name): track * (1, -1, 1) for name, track in aligned.items()}
    return [stride for side in (aligned, mirrored) for stride in _of_left(side, names, fps, height_m)]


def terms(phase: Float[np.ndarray, " sample"]) -> Float[np.ndarray, "sample term"]:
    """1, then cosine and sine of every harmonic."""
    angles = 2 * np.pi * phase[:, None] * np.arange(1, HARMONICS + 1)
    return np.concatenate([np.ones((len(phase), 1)), np.cos(angles), np.sin(angles)], axis=1)


def series_of(columns: Float[np.ndarray, "frame column"]) -> Float[np.ndarray, "term column"]:
    """The Fourier terms of one stride, from a heel strike to the next, both included."""
    phase = np.arange(len(columns)) / (len(columns) - 1)
    # The series is periodic, so the difference between the stride's ends is spread over it.
    closed = columns - np.outer(phase - 0.5, columns[-1] - columns[0])
    return np.linalg.lstsq(terms(phase[:-1]), closed[:-1], rcond=None)[0]


def _align_with_x(landmarks: Points) -> dict[str, Float[np.ndarray, "frame 3"]]:
    """The walk rotated so that it goes along x."""
    way = landmarks["pelvis"][-1, :2] - landmarks["pelvis"][0, :2]
    c, s = way / max(np.linalg.norm(way), 1e-9)
    R = np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]])
    return {name: track @ R.T for name, track in landmarks.items()}


def _of_left(aligned: Points, names: tuple[str, ...], fps: float, height_m: float) -> list[Stride]:
    return [_stride(aligned, names, fps, height_m, a, b) for a, b in pairwise(heel_strikes(aligned, fps, height_m).tolist())]


def _stride(aligned: Points, names: tuple[str, ...], fps: float, height_m: float, first: int, last: int) -> Stride:
    frames = slice(first, last + 1)
    pelvis = aligned["pelvis"][frames] / height_m
    phase = np.arange(last - first + 1) / (last - first)
    steady = np.outer(phase, pelvis[-1] - pelvis[0]) * (1, 1, 0)
    moved = pelvis - steady - (pelvis - steady).mean(axis=0) * (1, 1, 0)
    columns = np.concatenate([*(aligned[name][frames] / height_m - pelvis for name in names), moved], axis=1)
    return Stride(series_of(columns), np.log([(last - first) / fps, np.linalg.norm(pelvis[-1, :2] - pelvis[0, :2])]))


def _mirrored(name: str) -> str:
    return {"l_": "r_", "r_": "l_"}.get(name[:2], name[:2]) + name[2:]


NAME = "walking_cycle"
EXPLAINED = 0.95
ARRAYS = ("names", "mean", "modes", "pace", "pace_modes", "segments", "height_m")

# Walks have different lengths, so the axis has no fixed name.
type Walk = tuple[str, Mapping[str, np.ndarray], float]


@dataclass(frozen=True, eq=False)
class WalkingCycle:
    """Strides of one walker, in units of body height.

    Attributes:
        names: the points besides the pelvis.
        mean: Fourier terms; columns as in `Stride.series`.
        modes: Fourier terms of each mode, for one standard deviation.
        pace: logarithms of the mean stride's duration, s, and length, heights.
        pace_modes: change of `pace` by each mode.
        segments: distance of each point from its parent, heights.
        height_m: the walker's height.
    """

    names: tuple[str, ...]
    mean: Float[np.ndarray, "term column"]
    modes: Float[np.ndarray, "mode term column"]
    pace: Float[np.ndarray, "2"]
    pace_modes: Float[np.ndarray, "mode 2"]
    segments: Float[np.ndarray, " point"]
    height_m: float


@dataclass(frozen=True)
class Learned:
    """A cycle, its number of strides, the fraction of variance that its modes explain, and remarks on walks that were left out."""

    cycle: WalkingCycle
    strides: int
    explained: float
    left_out: tuple[str, ...]


def learn(walks: Sequence[Walk]) -> Learned:
    """Learn the cycle from one person's straight walks.

    Args:
        walks: for each walk its name, its landmarks (metres, z up) and its frames per second. Runs, and walks without a whole stride, are left out.

    Raises:
        InputError: fewer than two strides are left.
    """
    all_strides: list[Stride] = []
    used: list[Points] = []
    left_out: list[str] = []
    shared = [points_of(landmarks) for _, landmarks, _ in walks]
    names = tuple(name for name in max(shared, key=len, default=()) if all(name in points for points in shared))
    for name, landmarks, fps in walks:
        if not set(NEEDED) <= set(names):
            left_out.append(f"{name}: points unknown in some frames: left out")
        elif is_run(landmarks, fps):
            left_out.append(f"{name}: {speed(landmarks, fps):.1f} m/s is a run: left out")
        elif not (walk_strides := strides(landmarks, names, fps, height(landmarks, names))):
            left_out.append(f"{name}: no whole stride: left out")
        else:
            all_strides += walk_strides
            used.append(landmarks)
    if len(all_strides) < 2:
        problem = f"{len(all_strides)} strides ({'; '.join(left_out) or 'no walk'})"
        raise input_error("the walks", problem, "at least 2 whole strides", "give straight walks of at least two steps each")
    tall = float(np.mean([height(points, names) for points in used]))
    bones = np.mean([segments(points, names) for points in used], axis=0) / tall
    return _of_strides(all_strides, names, bones, tall, tuple(left_out))


def _of_strides(
    all_strides: list[Stride], names: tuple[str, ...], bones: Float[np.ndarray, " point"], tall: float, left_out: tuple[str, ...]
) -> Learned:
    rows = np.stack([np.concatenate([stride.series.ravel(), stride.pace]) for stride in all_strides])
    mean = rows.mean(axis=0)
    _, sizes, directions = np.linalg.svd(rows - mean, full_matrices=False)
    shares = np.cumsum(sizes**2) / max(float((sizes**2).sum()), 1e-12)
    count = int(np.searchsorted(shares, EXPLAINED)) + 1
    # A mode and its negative are equivalent: choose the one that lengthens the stride.
    signs = np.where(directions[:count, -1] < 0, -1.0, 1.0)
    modes = (signs * sizes[:count])[:, None] * directions[:count] / np.sqrt(len(all_strides) - 1)
    columns = 3 * len(names) + 3
    cycle = WalkingCycle(
        names, mean[:-2].reshape(TERMS, columns), modes[:, :-2].reshape(count, TERMS, columns), mean[-2:], modes[:, -2:], bones, tall
    )
    return Learned(cycle, len(all_strides), float(shares[count - 1]), left_out)


def save_cycle(cycle: WalkingCycle, path: Path) -> None:
    """Write a cycle as an .npz with single precision, modes with half precision.

    Raises:
        InputError: it cannot be written.
    """
    with replacing(path) as partial, partial.open("wb") as file:
        np.savez_compressed(
            file,
            names=np.array(cycle.names),
            mean=cycle.mean.astype(np.float32),
            modes=cycle.modes.astype(np.float16),
            pace=cycle.pace.astype(np.float32),
            pace_modes=cycle.pace_modes.astype(np.float32),
            segments=cycle.segments.astype(np.float32),
            height_m=np.float32(cycle.height_m),
        )


def load_cycle(path: Path | None = None) -> WalkingCycle:
    """Read a walking cycle; by default the one that ships with the package.

    Raises:
        InputError: the file does not exist or is malformed.
    """
    path = definitions_folder() / "learned" / f"{NAME}.npz" if path is None else path
    kind, remedy = "a walking cycle", "make one with `bayes-body learn walking-cycle`"
    arrays = read_arrays(path, ARRAYS, kind, remedy)
    try:
        return _checked(arrays)
    except (ValueError, KeyError) as error:
        raise input_error(path, f"other arrays ({type(error).__name__})", kind, remedy) from None


def _checked(arrays: Mapping[str, np.ndarray]) -> WalkingCycle:
    names = tuple(str(name) for name in arrays["names"])
    numbers = {key: arrays[key].astype(float) for key in ARRAYS[1:]}
    columns, count = 3 * len(names) + 3, len(numbers["modes"])
    shapes = {"mean": (TERMS, columns), "modes": (count, TERMS, columns), "pace": (2,), "pace_modes": (count, 2)}
    shapes |= {"segments": (len(names),), "height_m": ()}
    if any(numbers[key].shape != shape or not np.isfinite(numbers[key]).all() for key, shape in shapes.items()):
        raise ValueError
    mean, modes, pace, pace_modes, bones, tall = (numbers[key] for key in ARRAYS[1:])
    return WalkingCycle(names, mean, modes, pace, pace_modes, bones, float(tall))
