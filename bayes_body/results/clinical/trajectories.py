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
from bayes_body.results.posterior.blocks import placing_blocks, pooled, pose_blocks
from bayes_body.results.storage.saved_moments import markers_of_each, of_each
from bayes_body.results.storage.saved_run import SavedRun

if TYPE_CHECKING:
    import xarray as xr

# So many draws are enough for quantiles, and fit in memory over a long walk.
MOST_DRAWS = 500
# Most numbers of all paths of angles together: of a long recording fewer draws are taken, but not fewer than FEWEST_DRAWS.
MOST_NUMBERS, FEWEST_DRAWS = 2**24, 50
# Within so many degrees of gimbal lock, the first and the third angle of a joint say little.
LOCK_DEG = 15.0
TURN = 360.0


class AnglePaths(NamedTuple):
    """Clinical angles along the draws of a smoothed run.

    Attributes:
        names: names of the angles, without the side.
        sides: their sides.
        degrees: degrees, without jumps from frame to frame and without what is faster than 6 Hz.
        draws: which draws of `marker_paths` these are.
    """

    names: tuple[str, ...]
    sides: tuple[Side, ...]
    degrees: Float[np.ndarray, "draw frame angle"]
    draws: Int[np.ndarray, " draw"]

    @property
    def labels(self) -> tuple[str, ...]:
        """The angles with their sides, such as `knee_flexion_r`."""
        return tuple(f"{name}_{side}" if side else name for name, side in zip(self.names, self.sides, strict=True))


def marker_paths(run: SavedRun, names: Sequence[str]) -> Float[np.ndarray, "draw frame marker 3"]:
    """Return the paths of some markers, metres, of at most MOST_DRAWS draws of all runs together.

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
    paths = []
    for piece, changes in placing_blocks(run.tree, run.model.placing, width=3 * len(marker_names)):
        runs, draws = piece.poses.shape[:2]
        chosen = np.unravel_index(_evenly(runs * draws, MOST_DRAWS), (runs, draws))
        poses, *change_values = (values[chosen][None] for values in (piece.poses, *changes.values()))
        paths.append(markers_of_each(run, poses, dict(zip(changes, change_values, strict=True)))[:, :, places])
    return np.swapaxes(np.concatenate(paths), 0, 1)


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
    places = _evenly(pose.sizes["chain"] * pose.sizes["draw"], MOST_DRAWS)
    number = max(sum(len(joint.names) for joint in joints), 1) * pose.sizes["frame"]
    draws = _evenly(len(places), max(MOST_NUMBERS // number, FEWEST_DRAWS))
    if not joints:
        return AnglePaths((), (), np.zeros((len(draws), pose.sizes["frame"], 0)), draws)
    width, pieces = 9 * len(model.body.skeleton.topology.joint_names), []
    for piece in pose_blocks(tree, width=width, variable=model.body.variable):
        rotations = of_each(pooled(piece.poses)[:, places[draws]], lambda chunk: np.asarray(joint_frames(model.body, chunk).rotation))
        pieces.append(np.concatenate([joint.angles(rotations) for joint in joints], axis=-1))
    degrees = _aligned(np.degrees(np.swapaxes(np.concatenate(pieces), 0, 1)))
    columns, first = [], 0
    for joint in joints:
        columns += [first + place for place in determined(joint, degrees[..., first : first + len(joint.free)])]
        first += len(joint.free)
    labels = [(joint.convention.angles[k].name, joint.side) for joint in joints for k in joint.free]
    names, sides = zip(*(labels[column] for column in columns), strict=True) if columns else ((), ())
    return AnglePaths(names, sides, low_pass(degrees[..., columns], fps), draws)


def _evenly(count: int, most: int) -> Int[np.ndarray, " chosen"]:
    """Return at most `most` of `count` indices, evenly spaced."""
    return np.unique(np.linspace(0, count - 1, most).round().astype(int))


def _aligned(degrees: Float[np.ndarray, "draw frame angle"]) -> Float[np.ndarray, "draw frame angle"]:
    """Return the angles without jumps of whole turns: from frame to frame, and between draws. The first draw's mean is within half a turn of 0."""
    unwrapped = np.unwrap(degrees, period=TURN, axis=1)
    means = unwrapped.mean(axis=1, keepdims=True)
    reference = means[:1] - TURN * np.round(means[:1] / TURN)
    return unwrapped - TURN * np.round((means - reference) / TURN)


def determined(joint: Joint, degrees: Float[np.ndarray, "draw frame free"]) -> list[int]:
    """Return the columns of a joint's angles that are determined in all frames: all, or the second one if the joint comes near gimbal lock."""
    if 1 not in joint.free:
        return list(range(len(joint.free)))
    middle = joint.free.index(1)
    # The second angle locks at ±90°, or at 0 and 180° if the first axis comes again.
    angle = np.abs(degrees[..., middle].mean(axis=0))
    margin = np.abs(90 - angle) if joint.convention.sequence != "YXY" else np.minimum(np.abs(angle), np.abs(180 - angle))
    return list(range(len(joint.free))) if (margin > LOCK_DEG).all() else [middle]
