"""Mean, standard deviation and quantiles of a saved run's clinical angles: the angles of the draws, and never the angles of a mean."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from bayes_body.base.errors import input_error
from bayes_body.density.spaces import circle
from bayes_body.results.clinical.conventions import CLINICAL, GROUND, PELVIS, Convention, opensim_conventions
from bayes_body.results.clinical.joints import Joint, joint_frames, joints_of
from bayes_body.results.posterior.blocks import BLOCK
from bayes_body.results.posterior.moments import Moments, MomentsAndMedian, moments_and_median, moments_in
from bayes_body.results.storage.saved_moments import moments_of, of_each
from bayes_body.results.storage.saved_run import SavedRun

# The direction in which a person faces has no limits: it goes on from frame to frame. Other angles stay within half a turn of 0.
UNBOUNDED = (PELVIS.angles[0].name, GROUND.angles[2].name)
TURN = 360.0


class Curves(NamedTuple):
    """Angles, and for OpenSim positions too, over the frames.

    Attributes:
        names: their names, such as `knee_flexion_r`.
        moments: (frame, name), degrees and metres; of OpenSim's coordinates also the median.
    """

    names: tuple[str, ...]
    moments: Moments | MomentsAndMedian


def laboratory_of(up: int) -> tuple[int, int, int]:
    """Return the world's axes that are the laboratory's x, y (up) and z: a cyclic permutation, like that of an export with `--up y`."""
    return (up - 1) % 3, up, (up + 1) % 3


def clinical_angles(run: SavedRun, frames: range | None = None, block: int = BLOCK, previous: Float[np.ndarray, " name"] | None = None) -> Curves:
    """Return the clinical angles of a run, pooled over its independent filters; none if its body file names no segments.

    The mean is that on the circle. Draws are brought within half a turn of it before standard deviation and quantiles are computed.

    Args:
        run: the run, loaded from its folder.
        frames: numbers of the frames; all by default.
        block: largest number of frames in memory at a time.
        previous: the means in the frame before, from which an angle that is not bounded goes on.

    Raises:
        InputError: the run's model or session cannot be used.
    """
    names, _, angles = _angles(run, CLINICAL, frames, block, previous)
    return Curves(names, angles.moments)


def opensim_coordinates(run: SavedRun, frames: range | None = None, block: int = BLOCK, previous: Float[np.ndarray, " name"] | None = None) -> Curves:
    """Return the coordinates of OpenSim's models that a run determines: position (metres) and orientation of the pelvis, and joint angles.

    Their names are OpenSim's, and the pelvis is placed as OpenSim places it. The arguments are those of `clinical_angles`.

    Raises:
        InputError: the body file names no pelvis, or the run's model or session cannot be used.
    """
    body, segments = run.model.body, run.model.definition.body.clinical
    if "pelvis" not in segments:
        remedy = "add the pelvis to its table [clinical], or export csv"
        raise input_error(f"the body '{body.name}'", "no anatomical axes of a pelvis", "those that place an OpenSim model", remedy)
    pelvis = body.skeleton.topology.joint_names.index(segments["pelvis"].joint)
    order = list(laboratory_of("xyz".index(run.session.up)))

    def places(poses: Float[np.ndarray, "frame draw *shape"], weights: Float[np.ndarray, "frame draw"]) -> MomentsAndMedian:
        return moments_and_median(of_each(poses, lambda chunk: np.asarray(joint_frames(body, chunk).origin))[:, :, pelvis][..., order], weights)

    origin = moments_of(run, frames, block, 3 * len(body.skeleton.topology.joint_names), places)
    joints = _joints(run, opensim_conventions(segments))
    names = [name for joint in joints for name in joint.coordinates]
    # OpenSim's order: the rotations of the pelvis, its position, then the joints.
    named_columns = [place for place, name in enumerate(names) if name]
    first = sum(name.startswith("pelvis_") for name in names)
    previous_turned = None
    if previous is not None:
        previous_turned = np.full(len(names), np.nan)
        previous_turned[named_columns] = np.delete(previous, range(first, first + 3))
    *_, moments = _angles(run, opensim_conventions(segments), frames, block, previous_turned)
    columns = MomentsAndMedian(
        *(np.insert(turned[:, named_columns], [first] * 3, position, axis=1) for position, turned in zip(origin, moments, strict=True))
    )
    coordinates = [names[place] for place in named_columns]
    return Curves((*coordinates[:first], "pelvis_tx", "pelvis_ty", "pelvis_tz", *coordinates[first:]), columns)


def _joints(run: SavedRun, conventions: Sequence[Convention]) -> tuple[Joint, ...]:
    return joints_of(run.model.body, run.model.definition.body.clinical, laboratory_of("xyz".index(run.session.up)), conventions)


def _angles(
    run: SavedRun, conventions: Sequence[Convention], frames: range | None, block: int, previous: Float[np.ndarray, " name"] | None
) -> tuple[tuple[str, ...], tuple[str, ...], MomentsAndMedian]:
    """Return names, OpenSim's names, and moments in degrees."""
    joints = _joints(run, conventions)
    names = tuple(name for joint in joints for name in joint.names)
    coordinates = tuple(name for joint in joints for name in joint.coordinates)
    if not names:
        return (), (), MomentsAndMedian(*np.zeros((5, len(range(run.frames) if frames is None else frames), 0)))
    body, space = run.model.body, circle(names)

    def turns(poses: Float[np.ndarray, "frame draw *shape"], weights: Float[np.ndarray, "frame draw"]) -> MomentsAndMedian:
        rotations = of_each(poses, lambda chunk: np.asarray(joint_frames(body, chunk).rotation))
        return moments_in(space, np.concatenate([joint.angles(rotations) for joint in joints], axis=-1), weights, moments_and_median)

    moments = moments_of(run, frames, block, 9 * len(body.skeleton.topology.joint_names), turns)
    return names, coordinates, _wrap_near_zero(MomentsAndMedian(*map(np.degrees, moments)), [name in UNBOUNDED for name in names], previous)


def _wrap_near_zero(moments: MomentsAndMedian, unbounded: Sequence[bool], previous: Float[np.ndarray, " name"] | None) -> MomentsAndMedian:
    """Return the moments with each mean on the turn nearest to zero, or for an unbounded angle nearest to the frame before."""
    nearest = moments.mean - TURN * np.round(moments.mean / TURN)
    path = nearest if previous is None else np.concatenate([previous[None], nearest])
    mean = np.where(unbounded, np.unwrap(path, period=TURN, axis=0)[len(path) - len(nearest) :], nearest)
    shift = mean - moments.mean
    return MomentsAndMedian(mean, moments.sd, moments.q05 + shift, moments.q95 + shift, moments.q50 + shift)
