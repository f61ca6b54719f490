"""Mean and 90 % interval of every dof and clinical angle over time, and the same curves of the filter's run from which a smoothed run was made."""

from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray

from bayes_body.base.errors import InputError
from bayes_body.results.clinical.moments import Curves, clinical_angles
from bayes_body.results.posterior.blocks import coordinate_blocks, pooled, weights_of_runs
from bayes_body.results.posterior.moments import Moments, MomentsAndMedian, weighted_moments
from bayes_body.results.storage.run_file import read_record
from bayes_body.results.storage.saved_run import load_run
from bayes_body.view.colours import GREY

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from bayes_body.results.storage.saved_run import SavedRun

LEGEND = " Thin grey lines are the filter's mean (solid) and the ends of its 90 % interval (dotted): a filter's frame knows only the images up to it."


class FilterCurves(NamedTuple):
    """Curves of the filter's run at the frames of the smoothed run's curves.

    Attributes:
        dofs: (frame, dof), degrees and metres.
        clinical: the clinical angles, degrees; none if the body file names no segments.
    """

    dofs: Moments
    clinical: Curves


def units_of(run: "SavedRun") -> tuple[str, ...]:
    """Return the unit of each dof, `°` or `m`."""
    return tuple("m" if unit == "m" else "°" for space in run.spaces.values() for unit in space.tangent_units)


def dof_scale(units: tuple[str, ...]) -> Float[np.ndarray, " dof"]:
    """Return the factors that convert radians to degrees and leave metres unchanged."""
    return np.where(np.array(units) == "m", 1.0, 180 / np.pi)


def dof_curves(run: "SavedRun", frames: range) -> Moments:
    """Return the moments of the dofs, (frame, dof), degrees and metres; all runs have the same weight."""
    moments = []
    for piece in coordinate_blocks(run.tree, frames, spaces=run.spaces):
        moments.append(weighted_moments(pooled(piece.poses), pooled(weights_of_runs(piece.log_weights)) / piece.poses.shape[0]))
    scale = dof_scale(units_of(run))
    return Moments(*(np.concatenate(parts) * scale for parts in zip(*moments, strict=True)))


def clinical_curves(run: "SavedRun", frames: range) -> Curves:
    """Return the clinical angles, degrees; none if the body file names no segments, or if the model can no longer be built."""
    try:
        return clinical_angles(run, frames)
    except InputError:
        return Curves((), Moments(*np.zeros((4, len(frames), 0))))


def filter_curves(run: "SavedRun", frames: range) -> FilterCurves | None:
    """Return the curves of the filter's run; None if the run is not smoothed or made of several, or if the filter's run is gone or another one."""
    source = _source(run) if run.smoothed and not run.chains else None
    if source is None:
        return None
    with source:
        return FilterCurves(dof_curves(source, frames), clinical_curves(source, frames))


def _source(run: "SavedRun") -> "SavedRun | None":
    """Return the filter's run; None unless it has the id, the texts and the dofs that the smoothed run names.

    A stranger's run may name any folder of this machine.
    """
    folder = Path(run.smoothing["folder"])
    try:
        if read_record(folder)["check"]["run"] != run.smoothing["run"]:
            return None
        source = load_run(folder)
    except (InputError, OSError, ValueError):
        return None
    if not source.smoothed and source.texts == run.texts and source.frames == run.frames and _labels(source) == _labels(run):
        return source
    source.close()
    return None


def _labels(run: "SavedRun") -> list[tuple[str, ...]]:
    return [space.tangent_labels for space in run.spaces.values()]


def draw_filter(axes: "Axes", places: NDArray[Any], curves: Moments | MomentsAndMedian, column: int, bands: bool) -> None:
    """Draw the filter's mean, and with `bands` the ends of its 90 % interval, as thin grey lines; for a single frame there are none."""
    if len(places) > 1:
        mean, *ends = drawn_filter(curves, column, bands)
        axes.plot(places, mean, color=GREY, linewidth=0.8)
        for end in ends:
            axes.plot(places, end, color=GREY, linewidth=0.8, linestyle=":")


def drawn_filter(curves: Moments | MomentsAndMedian, column: int, bands: bool) -> list[NDArray[np.floating]]:
    """Return the curves that `draw_filter` draws, for which an axis needs room."""
    return [curve[:, column] for curve in ((curves.mean, curves.q05, curves.q95) if bands else (curves.mean,))]
