"""The draws of a smoothed run as whole trajectories: of its markers, and of its clinical angles.

Gait events, peaks and ranges of motion follow from these only: a filter's draws do not reach over frames.
"""

from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from bayes_body.base.errors import input_error
from bayes_body.model.build import Model
from bayes_body.results.clinical.conventions import Side
from bayes_body.results.clinical.gait import low_pass
from bayes_body.results.clinical.joints import Joint, joint_frames, joints_of
from bayes_body.results.clinical.moments import laboratory_of
from bayes_body.results.clinical.paths import ChosenColumns, PathsOfDraws, StoredPaths, mean_path
from bayes_body.results.posterior.blocks import placing_blocks, pooled, pose_blocks
from bayes_body.results.storage.saved_moments import markers_of_each, of_each
from bayes_body.results.storage.saved_run import SavedRun

if TYPE_CHECKING:
    import xarray as xr

# So many draws are enough for quantiles.
MOST_DRAWS = 500
# Most places of all paths of markers together, and most numbers of all paths of angles: of a long recording fewer draws are taken, but not fewer than
# FEWEST_DRAWS. Up to 11 000 frames, markers have the paths of MOST_DRAWS.
MOST_PLACES, MOST_NUMBERS, FEWEST_DRAWS = 11_000 * MOST_DRAWS, 2**24, 50
# Within so many degrees of gimbal lock, the first and the third angle of a joint say little.
LOCK_DEG = 15.0
TURN = 360.0


class AnglePaths(NamedTuple):
    """Clinical angles along the draws of a smoothed run.

    Attributes:
        names: names of the angles, without the side.
        sides: their sides.
        degrees: (draw, frame, angle), degrees, without jumps from frame to frame and without what is faster than 6 Hz.
        draws: which draws of `marker_paths` these are.
    """

    names: tuple[str, ...]
    sides: tuple[Side, ...]
    degrees: PathsOfDraws
    draws: Int[np.ndarray, " draw"]

    @property
    def labels(self) -> tuple[str, ...]:
        """The angles with their sides, such as `knee_flexion_r`."""
        return tuple(f"{name}_{side}" if side else name for name, side in zip(self.names, self.sides, strict=True))


def marker_paths(run: SavedRun, names: Sequence[str]) -> StoredPaths:
    """Return the paths (draw, frame, marker, 3) of some markers, metres, of at most MOST_DRAWS draws of all runs together.

    Args:
        run: a smoothed run.
        names: names of the body's markers.

    Raises:
        InputError: the run is not smoothed, or its body lacks a marker.
    """
    if not run.smoothed:
        remedy = f"smooth it first with `bayes-body smooth {run.folder}`"
        raise input_error(run.folder, "a run of a filter, whose draws do not reach over frames", "a smoothed run", remedy)
    marker_names = run.model.body.markers.names
    missing = [name for name in names if name not in marker_names]
    if missing:
        raise input_error(f"the body '{run.model.body.name}'", f"no marker {', '.join(missing)}", "one", "add it to the body file's [markers]")
    places = [marker_names.index(name) for name in names]
    pose = run.tree["posterior"][run.model.body.variable]
    runs, draws, frames = (pose.sizes[dim] for dim in ("chain", "draw", "frame"))
    chosen = _chosen_draws(runs * draws, frames)
    paths = StoredPaths((len(chosen), frames, len(places), 3))
    for piece, changes in placing_blocks(run.tree, run.model.placing, width=3 * len(marker_names)):
        poses, *change_values = (values[np.unravel_index(chosen, (runs, draws))][None] for values in (piece.poses, *changes.values()))
        block = markers_of_each(run, poses, dict(zip(changes, change_values, strict=True)))[:, :, places]
        paths.write(piece.frames[0], np.swapaxes(block, 0, 1))
    return paths


def angle_paths(tree: "xr.DataTree", model: Model, up: int, fps: float) -> AnglePaths:
    """Return the clinical angles along the draws of a smoothed run, of some of the draws of `marker_paths`.

    The first and the third angle of a joint are left out if the joint comes near gimbal lock: only their sum or difference is determined there.

    Args:
        tree: the posterior of a smoothed run.
        model: its model.
        up: index of the session's axis that points up.
        fps: frames a second.
    """
    joints = joints_of(model.body, model.definition.body.clinical, laboratory_of(up))
    pose = tree["posterior"][model.body.variable]
    frames, count = pose.sizes["frame"], sum(len(joint.free) for joint in joints)
    places = _chosen_draws(pose.sizes["chain"] * pose.sizes["draw"], frames)
    draws = _evenly(len(places), max(MOST_NUMBERS // (max(count, 1) * frames), FEWEST_DRAWS))
    degrees = StoredPaths((len(draws), frames, count))
    if not joints:
        return AnglePaths((), (), degrees, draws)
    for piece in pose_blocks(tree, width=9 * len(model.body.skeleton.topology.joint_names), variable=model.body.variable):
        rotations = of_each(pooled(piece.poses)[:, places[draws]], lambda chunk: np.asarray(joint_frames(model.body, chunk).rotation))
        block = np.concatenate([joint.angles(rotations) for joint in joints], axis=-1)
        degrees.write(piece.frames[0], np.degrees(np.swapaxes(block, 0, 1)))
    align(degrees)
    mean = mean_path(degrees)
    for draw, path in enumerate(degrees):
        degrees.write_path(draw, low_pass(path[None], fps)[0])
    columns, first = [], 0
    for joint in joints:
        columns += [first + place for place in determined(joint, mean[:, first : first + len(joint.free)])]
        first += len(joint.free)
    labels = [(joint.convention.angles[k].name, joint.side) for joint in joints for k in joint.free]
    names, sides = zip(*(labels[column] for column in columns), strict=True) if columns else ((), ())
    return AnglePaths(names, sides, ChosenColumns(degrees, columns), draws)


def _chosen_draws(count: int, frames: int) -> Int[np.ndarray, " chosen"]:
    """Return which of all draws give paths, of `count`."""
    return _evenly(count, min(MOST_DRAWS, max(MOST_PLACES // frames, FEWEST_DRAWS)))


def _evenly(count: int, most: int) -> Int[np.ndarray, " chosen"]:
    """Return at most `most` of `count` indices, evenly spaced."""
    return np.unique(np.linspace(0, count - 1, most).round().astype(int))


def align(degrees: StoredPaths) -> None:
    """Take out jumps of whole turns: from frame to frame, and between draws. The first draw's mean is then within half a turn of 0."""
    reference = None
    for draw, path in enumerate(degrees):
        unwrapped = np.unwrap(path, period=TURN, axis=0)
        mean = unwrapped.mean(axis=0)
        reference = mean - TURN * np.round(mean / TURN) if reference is None else reference
        degrees.write_path(draw, unwrapped - TURN * np.round((mean - reference) / TURN))


def determined(joint: Joint, degrees: Float[np.ndarray, "frame free"]) -> list[int]:
    """Return the columns of a joint's angles that are determined in all frames: all, or the second one if the joint comes near gimbal lock.

    Args:
        joint: the joint.
        degrees: the mean of its angles over the draws.
    """
    if 1 not in joint.free:
        return list(range(len(joint.free)))
    middle = joint.free.index(1)
    # The second angle locks at ±90°, or at 0 and 180° if the first axis comes again.
    angle = np.abs(degrees[:, middle])
    margin = np.abs(90 - angle) if joint.convention.sequence != "YXY" else np.minimum(np.abs(angle), np.abs(180 - angle))
    return list(range(len(joint.free))) if (margin > LOCK_DEG).all() else [middle]
