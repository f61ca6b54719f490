"""Several people of one recording in one file: the markers of all, each with the person before its name, over the frames in which anybody is there.

The prefix is `person_1:knee_r`, as Vicon separates a subject from its markers in C3D labels. A marker of somebody who is not there in a frame is
missing in it: residual -1 in C3D, `nan` in TRC.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
from jaxtyping import Float

from bayes_body.base.errors import input_error
from bayes_body.base.files.atomic import check_free, make_folder
from bayes_body.results.clinical.moments import Curves
from bayes_body.results.posterior.moments import Moments
from bayes_body.view.export.c3d import write_c3d
from bayes_body.view.export.formats import WRITERS, files_of
from bayes_body.view.export.motion import MODE_SEEKER_MOMENTS, Motion, RunMoments, read_motion
from bayes_body.view.export.world import Axis
from bayes_body.view.people import People

# The formats that hold markers only, so that one file can hold several people.
TOGETHER = ("trc", "c3d")
# Between a person and a marker.
SEPARATOR = ":"


def check_together(names: Sequence[str]) -> None:
    """Check that several people can be in one file of each format.

    Raises:
        InputError: a format holds one body.
    """
    single = [name for name in names if name not in TOGETHER]
    if single:
        problem = f"with --to {','.join(single)}, of which a file holds one body"
        raise input_error("--together", problem, " or ".join(TOGETHER), "leave it out: each person gets a file")


def export_people(
    people: People, outs: Mapping[str, Path], *, fps: float | None = None, up: Axis | None = None, overwrite: bool = False, spread: bool = False
) -> Motion:
    """Write all people into one file of each format, and return their motion. A person's gait events are only in the person's own file.

    Args:
        people: the people.
        outs: the file of each format, by the format's name.
        fps: as in `read_motion`.
        up: as in `read_motion`.
        overwrite: whether to replace existing files.
        spread: whether a C3D file has further points for standard deviation and quantiles.

    Raises:
        InputError: a format cannot hold several people, a file already exists, or one cannot be written. If a file exists, none is written.
    """
    check_together(tuple(outs))
    motion = joint_motion(people, fps, up)
    for name, out in outs.items():
        for file in files_of(name, out, motion.moments):
            check_free(file, overwrite)
    for name, out in outs.items():
        make_folder(out.parent)
        writer = partial(write_c3d, spread=spread) if name == "c3d" else WRITERS[name]
        writer(motion, out)
    return motion


def joint_motion(people: People, fps: float | None = None, up: Axis | None = None) -> Motion:
    """Return the markers of all people as one motion, without angles; markers are NaN where their person is not there.

    If one run is that of a mode seeker, only means are written: a file has the same moments for all.
    """
    motions = [read_motion(RunMoments(person.run), fps, up, "none") for person in people.persons]
    frames, first = len(people.frames), people.frames.start
    starts = [motion.first_frame - first for motion in motions]
    lost = np.zeros(frames, bool)
    for start, motion in zip(starts, motions, strict=True):
        lost[start : start + motion.frames] |= motion.lost
    return replace(
        motions[0],
        marker_names=tuple(
            f"{person.name}{SEPARATOR}{marker}" for person, motion in zip(people.persons, motions, strict=True) for marker in motion.marker_names
        ),
        markers=Moments(
            *(
                np.concatenate([_spread_out(getattr(motion.markers, field), start, frames) for start, motion in zip(starts, motions, strict=True)], 1)
                for field in Moments._fields
            )
        ),
        dof_names=(),
        dof_units=(),
        dofs=Moments(*np.zeros((4, frames, 0))),
        clinical=Curves((), Moments(*np.zeros((4, frames, 0)))),
        parts=None,
        lost=lost,
        moments=Moments._fields if all(motion.has_intervals for motion in motions) else MODE_SEEKER_MOMENTS,
        first_frame=first,
    )


def _spread_out(markers: Float[np.ndarray, "frame marker 3"], start: int, frames: int) -> Float[np.ndarray, "all marker 3"]:
    """Return the markers among `frames` frames, NaN before `start` and after their last."""
    joint = np.full((frames, *markers.shape[1:]), np.nan)
    joint[start : start + len(markers)] = markers
    return joint
