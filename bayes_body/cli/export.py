"""`bayes-body export`: write a run's motion for other programs."""

import math
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, TypedDict

import typer

from bayes_body.base.errors import input_error
from bayes_body.cli.plugin_option import Plugins, own_terms
from bayes_body.cli.terminal import say

if TYPE_CHECKING:
    from bayes_body.view.export.motion import LongMotion
    from bayes_body.view.export.world import Axis


class Options(TypedDict):
    """Options of an export, as `export_formats` takes them."""

    fps: float | None
    up: "Axis | None"
    overwrite: bool
    spread: bool


def export(
    runs: list[Path] = typer.Argument(help="Folder of a run made by `bayes-body track`; or those of several people of one recording."),
    to: str = typer.Option(..., "--to", help="trc (OpenSim, Pose2Sim), mot (OpenSim), c3d, bvh (Blender), csv or npz; several as mot,csv,c3d."),
    out: Path | None = typer.Option(
        None,
        "--out",
        help=(
            "The file; motion.FORMAT in the run's folder by default. For several formats: the files' name without an ending, or an existing folder. "
            "Of several people each has a file NAME_person_1.FORMAT, ..."
        ),
    ),
    up: str | None = typer.Option(
        None, "--up", help="Axis that points up: x, y or z; by default the session's, or y for bvh and mot. OpenSim needs y for trc too."
    ),
    rate: float | None = typer.Option(None, "--rate", help="Frames a second, if the session's are wrong; no frame is added or left out."),
    overwrite: bool = typer.Option(False, "--overwrite", help="Replace existing files."),
    spread: bool = typer.Option(False, "--spread", help="c3d only: standard deviation and quantiles of each axis as further points."),
    in_one_file: bool = typer.Option(False, "--together", help="trc and c3d: all people in one file, with markers such as person_1:knee_r."),
    plugin: Plugins = None,
) -> None:
    """Write mean, standard deviation and 5 % and 95 % quantiles of markers and (csv, npz) of joint angles, those of clinicians included.

    A mot file has the mean of OpenSim's coordinates, with standard deviation and quantiles in further files; a bvh file has the mean pose of a
    skeleton. A c3d file of a smoothed run has the gait events too. For a mode seeker's run only means are written: the spread of its particles is not
    a measure of uncertainty.
    """
    from bayes_body.base.config import configure

    configure()
    from bayes_body.results.storage.saved_run import load_run
    from bayes_body.view.export.formats import export_formats, files_of, formats_in, targets
    from bayes_body.view.export.world import AXES

    names = formats_in(to)
    axis: Axis | None = next((axis for axis in AXES if axis == up), None)
    if up is not None and axis is None:
        raise input_error("--up", up, "x, y or z", "name one of them")
    if rate is not None and not (math.isfinite(rate) and rate > 0):
        raise input_error("--rate", f"{rate:g}", "a finite number above 0", "give the number of frames a second")
    if spread and "c3d" not in names:
        raise input_error("--spread", f"with --to {to}", "c3d", "leave it out: the other formats always have the spread, or cannot store it")
    with own_terms(plugin):
        options: Options = {"fps": rate, "up": axis, "overwrite": overwrite, "spread": spread}
        if len(runs) > 1:
            _export_people(runs, names, out, in_one_file, options)
            return
        if in_one_file:
            raise input_error("--together", "with one run", "the runs of two or more people", "leave it out, or name the others' runs")
        outs = targets(names, out, runs[0])
        with load_run(runs[0]) as saved:
            motions = export_formats(saved, outs, **options)
            for line in _report(motions, str(saved.kernel["kind"]), saved.smoothed):
                say(line)
    for name, motion in motions.items():
        for file in files_of(name, outs[name], motion.moments):
            say(f"{file}")


def _export_people(runs: list[Path], names: tuple[str, ...], out: Path | None, in_one_file: bool, options: "Options") -> None:
    """Write a file for each person, beside each other, or one for all."""
    from bayes_body.view.export.formats import DEFAULT_STEM, WRITERS, export_formats, files_of, targets
    from bayes_body.view.export.people import check_together, export_people
    from bayes_body.view.people import open_people

    if in_one_file:
        check_together(names)
    with open_people(runs) as people:
        if in_one_file:
            outs = targets(names, out, people.folder)
            motion = export_people(people, outs, **options)
            say(f"{len(motion.marker_names)} markers of {len(people.persons)} people, {motion.frames} frames, {motion.up} up")
            for name, path in outs.items():
                for file in files_of(name, path, motion.moments):
                    say(f"{file}")
            return
        for person in people.persons:
            base = people.folder / DEFAULT_STEM if out is None else out / DEFAULT_STEM if out.is_dir() else out
            stem = base.stem if base.suffix[1:] in WRITERS else base.name
            outs = {name: base.with_name(f"{stem}_{person.name}.{name}") for name in names}
            motions = export_formats(person.run, outs, **options)
            say(f"{person.label}:")
            for line in _report(motions, str(person.run.kernel["kind"]), person.run.smoothed):
                say(line)
            for name, long_motion in motions.items():
                for file in files_of(name, outs[name], long_motion.moments):
                    say(f"{file}")


def _report(motions: "Mapping[str, LongMotion]", kernel: str, smoothed: bool) -> Iterator[str]:
    motion = next(iter(motions.values()))
    by_axis: dict[str, list[str]] = {}
    for name, named_motion in motions.items():
        by_axis.setdefault(named_motion.up, []).append(name)
    up = ", ".join(f"{axis} up{f' ({", ".join(names)})' if len(by_axis) > 1 else ''}" for axis, names in by_axis.items())
    yield f"{len(motion.marker_names)} markers, {motion.frames} frames at {motion.fps:g} a second, {up}"
    if not motion.has_intervals:
        yield f"Means only: the kernel {kernel} is a mode seeker, and the spread of its particles is not a measure of uncertainty."
    if motion.lost.any():
        from bayes_body.results.posterior.diagnostics import frame_ranges

        lost = (motion.first_frame + motion.lost.nonzero()[0]).tolist()
        yield f"{frame_ranges(lost)}: lost, or the body is off the person; do not use the values there."
    if "c3d" in motions:
        from bayes_body.view.export.c3d import written_events

        count = len(written_events(motions["c3d"].events))
        why = "" if smoothed else ": a filter's draws do not reach over frames; export the run that `bayes-body smooth` makes of this one"
        yield f"c3d: {count or 'no'} gait events{'' if count else why}."
