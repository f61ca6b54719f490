"""`bayes-body export`: a run's motion for other programs."""

import math
from pathlib import Path
from typing import TYPE_CHECKING

import typer

from bayes_body.cli.plugin_option import Plugins, own_terms
from bayes_body.errors import input_error

if TYPE_CHECKING:
    from bayes_body.export.motion import Axis, Motion

# The file's name in the run's folder, where none is given.
DEFAULT_STEM = "motion"


def export(
    run: Path = typer.Argument(help="Folder of a run, as `bayes-body track` makes it."),
    to: str = typer.Option(..., "--to", help="trc (OpenSim, Pose2Sim), c3d, bvh (Blender), csv or npz."),
    out: Path | None = typer.Option(None, "--out", help="File to write; motion.FORMAT in the run's folder by default."),
    up: str | None = typer.Option(None, "--up", help="Axis that shall point up: x, y or z; the session's by default, y in bvh. OpenSim wants y."),
    rate: float | None = typer.Option(None, "--rate", help="Frames a second to write, where the session's are wrong; no frame is made or left out."),
    intervals: bool = typer.Option(False, "--intervals", help="Add points for standard deviations and quantiles (c3d only, which has means alone)."),
    overwrite: bool = typer.Option(False, "--overwrite", help="Replace files that are there already."),
    plugin: Plugins = None,
) -> None:
    """Write mean, standard deviation and 5 % and 95 % quantiles of markers, and (csv, npz) of joint angles; or (bvh) the mean pose of a skeleton."""
    from bayes_body.config import configure

    configure()
    from bayes_body.export.formats import check_format, files_of
    from bayes_body.export.formats import export as write
    from bayes_body.export.motion import AXES
    from bayes_body.storage.saved_run import load_run

    axis: Axis | None = next((axis for axis in AXES if axis == up), None)
    if up is not None and axis is None:
        raise input_error("--up", up, "x, y or z", "name one of them")
    if rate is not None and not (math.isfinite(rate) and rate > 0):
        raise input_error("--rate", f"{rate:g}", "a finite number above 0", "give the frames a second")
    file = out or run / f"{DEFAULT_STEM}.{check_format(to)}"
    with own_terms(plugin), load_run(run) as saved:
        motion = write(saved, check_format(to), file, fps=rate, up=axis, intervals=intervals, overwrite=overwrite)
    typer.echo(_told(motion, files_of(to, file)))


def _told(motion: "Motion", files: tuple[Path, ...]) -> str:
    written = f"{', '.join(map(str, files))}: {len(motion.marker_names)} markers, {motion.frames} frames at {motion.fps:g} a second, {motion.up} up"
    if not motion.lost.any():
        return written
    from bayes_body.posterior.diagnostics import frame_ranges

    return f"{written}\n{frame_ranges(motion.lost.nonzero()[0].tolist())}: lost; what stands there is a prediction, with its wide spread."
