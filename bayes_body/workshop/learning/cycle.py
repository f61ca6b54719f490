r"""A walking cycle: a walker's mean stride and the main modes of variation between strides, $x = \bar x + \sum_k c_k m_k$ with $c_k \sim N(0, 1)$.

Strides are those of `bayes_body.workshop.learning.gait`. Modes are the first singular vectors of the centred strides, enough to explain 95 % of the
variance.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float

from bayes_body.base.errors import input_error
from bayes_body.base.files.arrays_file import read_arrays
from bayes_body.base.files.atomic import replacing
from bayes_body.base.files.shipped import definitions_folder
from bayes_body.workshop.learning.gait import NEEDED, TERMS, Points, Stride, height, is_run, points_of, segments, speed, strides

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
