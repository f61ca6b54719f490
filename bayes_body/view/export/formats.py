"""The formats by name, and the export to one or several of them."""

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path

from bayes_body.base.errors import InputError, input_error, nearest
from bayes_body.base.files.atomic import check_free, make_folder
from bayes_body.results.posterior.moments import Moments
from bayes_body.results.storage.saved_run import SavedRun
from bayes_body.view.export.bvh import write_bvh
from bayes_body.view.export.c3d import write_c3d
from bayes_body.view.export.csv import write_csv, write_npz
from bayes_body.view.export.mot import mot_files, write_mot
from bayes_body.view.export.motion import MODE_SEEKER_MOMENTS, Angles, LongMotion, Motion, RunMoments
from bayes_body.view.export.trc import trc_files, write_trc
from bayes_body.view.export.world import Axis

WRITERS: dict[str, Callable[[Motion | LongMotion, Path], None]] = {
    "trc": write_trc,
    "mot": write_mot,
    "csv": write_csv,
    "npz": write_npz,
    "c3d": write_c3d,
    "bvh": write_bvh,
}
# Programs assume that y points up in a BVH file, and OpenSim in a MOT file.
USUAL_UP: dict[str, Axis] = {"bvh": "y", "mot": "y"}
ANGLES: dict[str, Angles] = {"csv": "clinical", "npz": "clinical", "mot": "opensim"}
WITH_EVENTS = ("c3d",)
# The files' name without its ending, if none is given.
DEFAULT_STEM = "motion"


def check_format(name: str) -> str:
    """Return the name if a format of that name exists.

    Raises:
        InputError: there is no such format.
    """
    if name not in WRITERS:
        similar = nearest(name, WRITERS)
        listing = "" if similar.startswith("known") else f" Known: {', '.join(sorted(WRITERS))}."
        raise InputError(f"--to: format '{name}' does not exist; {similar}{listing}")
    return name


def formats_in(text: str) -> tuple[str, ...]:
    """Return the formats of a list such as `mot,csv,c3d`, without repetition.

    Raises:
        InputError: one of them does not exist.
    """
    return tuple(dict.fromkeys(check_format(name.strip()) for name in text.split(",")))


def targets(names: Sequence[str], out: Path | None, run: Path) -> dict[str, Path]:
    """Return the file of each format: `out` itself for one format; for several, `out` with each format's ending, or in the folder `out`.

    Args:
        names: the formats.
        out: the file; for several formats their common name without an ending, or an existing folder. None for `motion` in the run's folder.
        run: the run's folder.

    Raises:
        InputError: there are several formats, and `out` has the ending of one.
    """
    if out is None or (out.is_dir() and len(names) > 1):
        folder = run if out is None else out
        return {name: folder / f"{DEFAULT_STEM}.{name}" for name in names}
    if len(names) == 1:
        return {names[0]: out}
    if out.suffix[1:] in WRITERS:
        remedy = f"give --out {out.with_suffix('')}, or one format"
        raise input_error("--out", f"{out} for {len(names)} formats", "a name without an ending, or a folder", remedy)
    return {name: out.with_name(f"{out.name}.{name}") for name in names}


def files_of(name: str, out: Path, moments: Sequence[str] = Moments._fields) -> tuple[Path, ...]:
    """Return the files that a format writes for `out`: TRC and MOT write one for each moment, the others write one."""
    several = {"trc": trc_files, "mot": mot_files}
    return tuple(several[name](out, moments).values()) if name in several else (out,)


def export(
    run: SavedRun, name: str, out: Path, *, fps: float | None = None, up: Axis | None = None, overwrite: bool = False, spread: bool = False
) -> Motion:
    """Write a run's motion in one format, and return it. The arguments are those of `export_formats`.

    Raises:
        InputError: as for `export_formats`.
    """
    return export_formats(run, {name: out}, fps=fps, up=up, overwrite=overwrite, spread=spread)[name].in_memory


def export_formats(
    run: SavedRun, outs: Mapping[str, Path], *, fps: float | None = None, up: Axis | None = None, overwrite: bool = False, spread: bool = False
) -> dict[str, LongMotion]:
    """Write a run's motion in several formats, and return it as each of them has it. Of a run of few frames, what they share is computed once.

    Args:
        run: the run, loaded from its folder.
        outs: the file of each format, by the format's name.
        fps: as in `read_motion`.
        up: as in `read_motion`; y by default for BVH and MOT.
        overwrite: whether to replace existing files.
        spread: whether a C3D file has further points for standard deviation and quantiles; other formats have them whenever they can store them.

    Raises:
        InputError: there is no such format, a file already exists, or one cannot be written. If a file exists, none is written.
    """
    for name, out in outs.items():
        for file in files_of(check_format(name), out, MODE_SEEKER_MOMENTS if run.mode_seeker else Moments._fields):
            check_free(file, overwrite)
    for out in outs.values():
        make_folder(out.parent)
    moments = RunMoments(run)
    motions = {name: LongMotion(moments, fps, up or USUAL_UP.get(name), ANGLES.get(name, "none"), name in WITH_EVENTS) for name in outs}
    for name, motion in motions.items():
        writer = partial(write_c3d, spread=spread) if name == "c3d" else WRITERS[name]
        writer(motion, outs[name])
    return motions
