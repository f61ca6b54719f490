"""The formats by name, and writing one."""

from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

from bayes_body.errors import InputError, input_error, nearest
from bayes_body.export.bvh import write_bvh
from bayes_body.export.c3d import write_c3d
from bayes_body.export.csv import write_csv
from bayes_body.export.motion import MODE_SEEKER_MOMENTS, Axis, Motion, read_motion
from bayes_body.export.npz import write_npz
from bayes_body.export.trc import trc_files, write_trc
from bayes_body.files.atomic import make_folder, refused
from bayes_body.posterior.moments import Moments
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


def files_of(name: str, out: Path, moments: Sequence[str] = Moments._fields) -> tuple[Path, ...]:
    """The files that a format writes for `out`: TRC one for each moment, the others one."""
    return tuple(trc_files(out, moments).values()) if name == "trc" else (out,)


def export(
    run: SavedRun, name: str, out: Path, *, fps: float | None = None, up: Axis | None = None, overwrite: bool = False, spread: bool = False
) -> Motion:
    """Write a run's motion, and return it.

    Args:
        run: read back from its folder.
        name: of the format.
        out: the file.
        fps: as of `read_motion`.
        up: as of `read_motion`; of BVH y by default.
        overwrite: whether an existing file is replaced.
        spread: whether a C3D file has further points for standard deviation and quantiles; the other formats always have them where they can.

    Raises:
        InputError: no such format, a file that exists already, or one that cannot be written.
    """
    writer = partial(write_c3d, spread=spread) if check_format(name) == "c3d" else WRITERS[name]
    for file in files_of(name, out, MODE_SEEKER_MOMENTS if run.mode_seeker else Moments._fields):
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
