"""The formats by name, and writing one."""

from collections.abc import Callable
from functools import partial
from pathlib import Path

from bayes_body.errors import InputError, input_error, nearest
from bayes_body.export.bvh import write_bvh
from bayes_body.export.c3d import write_c3d
from bayes_body.export.csv import write_csv
from bayes_body.export.motion import Axis, Motion, read_motion
from bayes_body.export.npz import write_npz
from bayes_body.export.trc import trc_files, write_trc
from bayes_body.files.atomic import make_folder, refused
from bayes_body.storage.saved_run import SavedRun

WRITERS: dict[str, Callable[[Motion, Path], None]] = {"trc": write_trc, "csv": write_csv, "npz": write_npz, "c3d": write_c3d, "bvh": write_bvh}
# Programs take it for granted that y points up in a BVH file.
USUAL_UP: dict[str, Axis] = {"bvh": "y"}


def check_format(name: str) -> str:
    """The name of a format that exists.

    Raises:
        InputError: there is none of that name.
    """
    if name not in WRITERS:
        raise InputError(f"--to: format '{name}' does not exist; {nearest(name, WRITERS)}")
    return name


def files_of(name: str, out: Path) -> tuple[Path, ...]:
    """What a format writes where `out` is asked for: TRC four files, the others one."""
    return tuple(trc_files(out).values()) if name == "trc" else (out,)


def export(
    run: SavedRun, name: str, out: Path, *, fps: float | None = None, up: Axis | None = None, intervals: bool = False, overwrite: bool = False
) -> Motion:
    """Write a run's motion; returns what was written.

    Args:
        run: read back from its folder.
        name: of the format.
        out: the file.
        fps: as of `read_motion`.
        up: as of `read_motion`; of BVH y by default.
        intervals: whether a C3D file has points for standard deviations and quantiles; of no other format.
        overwrite: whether a file that is there is replaced.

    Raises:
        InputError: no such format, intervals of another format than C3D, a file that is there, or one that cannot be written.
    """
    writer = WRITERS[check_format(name)]
    if intervals:
        if name != "c3d":
            raise input_error("--intervals", f"given with --to {name}", "--to c3d", "leave it out")
        writer = partial(write_c3d, intervals=True)
    for file in files_of(name, out):
        _check_free(file, overwrite)
    make_folder(out.parent)
    motion = read_motion(run, fps, up or USUAL_UP.get(name))
    writer(motion, out)
    return motion


def _check_free(file: Path, overwrite: bool) -> None:
    try:
        folder, there = file.is_dir(), file.exists()
    # A name that is too long, for one.
    except OSError as error:
        raise refused(file, "written", error) from None
    if folder:
        raise input_error(file, "a folder", "the name of a file", "name one in it with --out")
    if there and not overwrite:
        raise input_error(file, "is there already", "a file that is not", "name another with --out, or replace it with --overwrite")
