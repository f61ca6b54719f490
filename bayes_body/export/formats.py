"""The formats by name, and the export to one of them."""

from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

from bayes_body.clinical.moments import Curves, clinical_angles, opensim_coordinates
from bayes_body.errors import InputError, nearest
from bayes_body.export.bvh import write_bvh
from bayes_body.export.c3d import write_c3d
from bayes_body.export.csv import write_csv
from bayes_body.export.mot import mot_files, write_mot
from bayes_body.export.motion import MODE_SEEKER_MOMENTS, Axis, Motion, no_angles, read_motion
from bayes_body.export.npz import write_npz
from bayes_body.export.trc import trc_files, write_trc
from bayes_body.files.atomic import make_folder
from bayes_body.files.existing import check_free
from bayes_body.posterior.moments import Moments
from bayes_body.storage.saved_run import SavedRun

WRITERS: dict[str, Callable[[Motion, Path], None]] = {
    "trc": write_trc,
    "mot": write_mot,
    "csv": write_csv,
    "npz": write_npz,
    "c3d": write_c3d,
    "bvh": write_bvh,
}
# Programs assume that y points up in a BVH file, and OpenSim in a MOT file.
USUAL_UP: dict[str, Axis] = {"bvh": "y", "mot": "y"}
ANGLES: dict[str, Callable[[SavedRun], Curves]] = {"csv": clinical_angles, "npz": clinical_angles, "mot": opensim_coordinates}


def check_format(name: str) -> str:
    """Return the name if a format of that name exists.

    Raises:
        InputError: there is no such format.
    """
    if name not in WRITERS:
        raise InputError(f"--to: format '{name}' does not exist; {nearest(name, WRITERS)}")
    return name


def files_of(name: str, out: Path, moments: Sequence[str] = Moments._fields) -> tuple[Path, ...]:
    """Return the files that a format writes for `out`: TRC writes one for each moment, MOT one for the standard deviation, the others write one."""
    several = {"trc": trc_files, "mot": mot_files}
    return tuple(several[name](out, moments).values()) if name in several else (out,)


def export(
    run: SavedRun, name: str, out: Path, *, fps: float | None = None, up: Axis | None = None, overwrite: bool = False, spread: bool = False
) -> Motion:
    """Write a run's motion, and return it.

    Args:
        run: the run, loaded from its folder.
        name: the format's name.
        out: the file.
        fps: as in `read_motion`.
        up: as in `read_motion`; y by default for BVH and MOT.
        overwrite: whether to replace an existing file.
        spread: whether a C3D file has further points for standard deviation and quantiles; other formats have them whenever they can store them.

    Raises:
        InputError: there is no such format, the file already exists, or it cannot be written.
    """
    writer = partial(write_c3d, spread=spread) if check_format(name) == "c3d" else WRITERS[name]
    for file in files_of(name, out, MODE_SEEKER_MOMENTS if run.mode_seeker else Moments._fields):
        check_free(file, overwrite)
    make_folder(out.parent)
    motion = read_motion(run, fps, up or USUAL_UP.get(name), ANGLES.get(name, no_angles))
    writer(motion, out)
    return motion
