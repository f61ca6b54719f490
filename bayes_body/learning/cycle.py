r"""A walking cycle: the mean stride of a walker and the first modes in which strides differ, $x = \bar x + \sum_k c_k m_k$ with $c_k \sim N(0, 1)$.

Strides are those of `bayes_body.learning.gait`; modes are the first left singular vectors of the strides about their mean, as many as explain 95 %.
"""

import io
import zipfile
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float

from bayes_body.errors import input_error
from bayes_body.files.atomic import replacing
from bayes_body.learning.gait import NEEDED, TERMS, Points, Stride, height, is_run, points_of, segments, speed, strides
from bayes_body.model.definition import definitions_folder

NAME = "walking_cycle"
EXPLAINED = 0.95
ARRAYS = ("names", "mean", "modes", "pace", "pace_modes", "segments", "height_m")

# Walks are of different lengths: one name of an axis would not do.
type Walk = tuple[str, Mapping[str, np.ndarray], float]


@dataclass(frozen=True, eq=False)
class WalkingCycle:
    """Strides of one walker, in heights.

    Attributes:
        names: of the points beside the pelvis.
        mean: Fourier terms; columns as `Stride.series`.
        modes: likewise, one standard deviation each.
        pace: logarithms of the mean stride's duration, s, and length, heights.
        pace_modes: what each mode adds to them.
        segments: the distance of each point from what it hangs on, heights.
        height_m: of the walker.
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
    """A cycle, how many strides it is the mean of, what share of their spread its modes explain, and sentences on walks that were left out."""

    cycle: WalkingCycle
    strides: int
    explained: float
    left_out: tuple[str, ...]


def learn(walks: Sequence[Walk]) -> Learned:
    """The cycle of one person's walks straight ahead.

    Args:
        walks: of each its name, its landmarks (metres, z up) and its frames a second. Runs, and what has no whole stride, are left out.

    Raises:
        InputError: fewer than two strides are left.
    """
    found: list[Stride] = []
    used: list[Points] = []
    left_out: list[str] = []
    shared = [points_of(landmarks) for _, landmarks, _ in walks]
    names = tuple(name for name in max(shared, key=len, default=()) if all(name in each for each in shared))
    for name, landmarks, fps in walks:
        if not set(NEEDED) <= set(names):
            left_out.append(f"{name}: points unknown in some frames: left out")
        elif is_run(landmarks, fps):
            left_out.append(f"{name}: {speed(landmarks, fps):.1f} m/s is a run: left out")
        elif not (here := strides(landmarks, names, fps, height(landmarks, names))):
            left_out.append(f"{name}: no whole stride: left out")
        else:
            found += here
            used.append(landmarks)
    if len(found) < 2:
        told = f"{len(found)} strides ({'; '.join(left_out) or 'no walk'})"
        raise input_error("the walks", told, "at least 2 whole strides", "give walks straight ahead of at least two steps each")
    tall = float(np.mean([height(each, names) for each in used]))
    bones = np.mean([segments(each, names) for each in used], axis=0) / tall
    return _of_strides(found, names, bones, tall, tuple(left_out))


def _of_strides(found: list[Stride], names: tuple[str, ...], bones: Float[np.ndarray, " point"], tall: float, left_out: tuple[str, ...]) -> Learned:
    rows = np.stack([np.concatenate([stride.series.ravel(), stride.pace]) for stride in found])
    mean = rows.mean(axis=0)
    _, sizes, directions = np.linalg.svd(rows - mean, full_matrices=False)
    shares = np.cumsum(sizes**2) / max(float((sizes**2).sum()), 1e-12)
    count = int(np.searchsorted(shares, EXPLAINED)) + 1
    # A mode and its negative are the same: the one that lengthens the stride is kept.
    signs = np.where(directions[:count, -1] < 0, -1.0, 1.0)
    modes = (signs * sizes[:count])[:, None] * directions[:count] / np.sqrt(len(found) - 1)
    columns = 3 * len(names) + 3
    cycle = WalkingCycle(
        names, mean[:-2].reshape(TERMS, columns), modes[:, :-2].reshape(count, TERMS, columns), mean[-2:], modes[:, -2:], bones, tall
    )
    return Learned(cycle, len(found), float(shares[count - 1]), left_out)


def save_cycle(cycle: WalkingCycle, path: Path) -> None:
    """Write a cycle as an .npz of single precision, modes of half.

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
    """A walking cycle from its file; the shipped one by default.

    Raises:
        InputError: no such file, or not of that form.
    """
    path = definitions_folder() / "learned" / f"{NAME}.npz" if path is None else path
    kind, remedy = "a walking cycle", "make one with `bayes-body learn walking-cycle`"
    try:
        content = path.read_bytes()
    except OSError as error:
        raise input_error(path, f"cannot be read ({error.strerror})", kind, remedy) from None
    try:
        with np.load(io.BytesIO(content), allow_pickle=False) as file:
            arrays = {key: file[key] for key in ARRAYS}
        return _checked(arrays)
    except (ValueError, TypeError, KeyError, OSError, EOFError, zipfile.BadZipFile, zlib.error) as error:
        raise input_error(path, f"no such archive, or damaged ({type(error).__name__})", kind, remedy) from None


def _checked(arrays: dict[str, np.ndarray]) -> WalkingCycle:
    names = tuple(str(name) for name in arrays["names"])
    numbers = {key: arrays[key].astype(float) for key in ARRAYS[1:]}
    columns, count = 3 * len(names) + 3, len(numbers["modes"])
    shapes = {"mean": (TERMS, columns), "modes": (count, TERMS, columns), "pace": (2,), "pace_modes": (count, 2)}
    shapes |= {"segments": (len(names),), "height_m": ()}
    if any(numbers[key].shape != shape or not np.isfinite(numbers[key]).all() for key, shape in shapes.items()):
        raise ValueError
    mean, modes, pace, pace_modes, bones, tall = (numbers[key] for key in ARRAYS[1:])
    return WalkingCycle(names, mean, modes, pace, pace_modes, bones, float(tall))
