"""`bayes-body export`: write a run's motion for other programs."""

import math
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import typer

from bayes_body.cli.plugin_option import Plugins, own_terms
from bayes_body.cli.terminal import say
from bayes_body.errors import input_error

if TYPE_CHECKING:
    from bayes_body.export.motion import Axis, Motion

# The file's name in the run's folder, if none is given.
DEFAULT_STEM = "motion"


def export(
    run: Path = typer.Argument(help="Folder of a run made by `bayes-body track`."),
    to: str = typer.Option(..., "--to", help="trc (OpenSim, Pose2Sim), mot (OpenSim), c3d, bvh (Blender), csv or npz."),
    out: Path | None = typer.Option(None, "--out", help="The file; motion.FORMAT in the run's folder by default."),
    up: str | None = typer.Option(
        None, "--up", help="Axis that points up: x, y or z; by default the session's, or y for bvh and mot. OpenSim needs y for trc too."
    ),
    rate: float | None = typer.Option(None, "--rate", help="Frames a second, if the session's are wrong; no frame is added or left out."),
    overwrite: bool = typer.Option(False, "--overwrite", help="Replace existing files."),
    spread: bool = typer.Option(False, "--spread", help="c3d only: standard deviation and quantiles of each axis as further points."),
    plugin: Plugins = None,
) -> None:
    """Write mean, standard deviation and 5 % and 95 % quantiles of markers and (csv, npz) of joint angles, those of clinicians included.

    A mot file has the mean of OpenSim's coordinates, with their standard deviation in a second file; a bvh file has the mean pose of a skeleton.
    For a mode seeker's run only means are written: the spread of its particles is not a measure of uncertainty.
    """
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
        raise input_error("--rate", f"{rate:g}", "a finite number above 0", "give the number of frames a second")
    if spread and check_format(to) != "c3d":
        raise input_error("--spread", f"with --to {to}", "c3d", "leave it out: the other formats always have the spread, or cannot store it")
    file = out or run / f"{DEFAULT_STEM}.{check_format(to)}"
    with own_terms(plugin), load_run(run) as saved:
        motion = write(saved, check_format(to), file, fps=rate, up=axis, overwrite=overwrite, spread=spread)
        kernel = str(saved.kernel["kind"])
    for line in _report(motion, files_of(to, file, motion.moments), kernel):
        say(line)


def _report(motion: "Motion", files: tuple[Path, ...], kernel: str) -> Iterator[str]:
    yield f"{', '.join(map(str, files))}: {len(motion.marker_names)} markers, {motion.frames} frames at {motion.fps:g} a second, {motion.up} up"
    if not motion.has_intervals:
        yield f"Means only: the kernel {kernel} is a mode seeker, and the spread of its particles is not a measure of uncertainty."
    if motion.lost.any():
        from bayes_body.posterior.diagnostics import frame_ranges

        lost = (motion.first_frame + motion.lost.nonzero()[0]).tolist()
        yield f"{frame_ranges(lost)}: lost, or the body is off the person; do not use the values there."
