"""Five walks, filmed by one camera from the side: the cycle that ships, two captured walks that the likelihood learned from, and two that it did not.

Nothing that ships or was tuned has seen the last two (subjects 35 and 38 of the CMU database). The likelihood's statistics were learned from other
frames, people, rooms and cameras of the two walks before them.
"""

import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

from bayes_body.base.errors import input_error
from bayes_body.base.files.shipped import definitions_folder
from bayes_body.base.progress import Watch, unwatched
from bayes_body.recording.readers.rig import Rig, read_rig
from bayes_body.recording.session.read import FILE_NAME, load_session
from bayes_body.recording.session.session import CameraSpec, Session

sys.path.append(str(Path(__file__).parents[1]))
from filmed_walk import film

# The paper's images are of one camera; with twice the pixels of the rig, a shank is about 40 pixels wide, and edges at three scales fit.
FINER = 2


class Walk(NamedTuple):
    """A walk to film.

    Attributes:
        name: for tables and folders.
        motion: path below the folder of captured motion; None: the walking cycle that ships.
        seed: of the person, the room and the noise.
        held_out: whether nothing was learned from it or tuned on it.
    """

    name: str
    motion: str | None
    seed: int
    held_out: bool


WALKS = (
    Walk("cycle", None, 200, held_out=False),
    Walk("07_01", "07/07_01.amc", 201, held_out=False),
    Walk("16_15", "16/16_15.amc", 202, held_out=False),
    Walk("35_01", "35/35_01.amc", 203, held_out=True),
    Walk("38_01", "38/38_01.amc", 204, held_out=True),
)


def filmed(walk: Walk, folder: Path, mocap: Path | None, frames: int, watch: Watch = unwatched) -> Session:
    """Film a walk, or read it if an earlier run has filmed it.

    Args:
        walk: the walk.
        folder: for the sessions of all walks.
        mocap: folder with the captured walks.
        frames: number of frames.
        watch: wraps the frames to show progress.

    Raises:
        InputError: there is no folder of captured walks, or one cannot be read; the folder holds a shorter film.
    """
    session = folder / f"walk_{walk.name}"
    if not (session / FILE_NAME).exists():
        if walk.motion is not None and mocap is None:
            raise input_error("--mocap", "none given", "a folder with captured walks of the CMU database", "name it, or leave out the captured walks")
        motion = None if walk.motion is None or mocap is None else mocap / walk.motion
        return film(session, side_camera(), frames, walk.seed, motion, f"walk {walk.name} from the side", watch)
    read = load_session(session)
    if read.frames < frames:
        raise input_error(session, f"a film of {read.frames} frames", f"{frames} or more", "name another --out, or remove it")
    return read


def side_camera() -> Rig:
    """Return the rig `side_1` with FINER times the pixels."""
    rig = read_rig(definitions_folder() / "rigs" / "side_1.toml")
    return replace(rig, cameras=tuple(_finer(camera) for camera in rig.cameras))


def _finer(camera: CameraSpec) -> CameraSpec:
    width, height = (FINER * side for side in camera.size_px)
    x, y = (FINER * focal for focal in camera.focal_px)
    # A pixel's centre has whole numbers, so the image begins half a pixel before 0.
    column, row = (FINER * (centre + 0.5) - 0.5 for centre in camera.centre_px)
    return replace(camera, size_px=(width, height), focal_px=(x, y), centre_px=(column, row), skew=FINER * camera.skew)


def chosen(names: Sequence[str] | None) -> list[Walk]:
    """Return the walks with these names; all of them without names."""
    return [walk for walk in WALKS if names is None or walk.name in names]
