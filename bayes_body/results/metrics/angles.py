"""Clinical angles against the true ones, where the session's truth has joint angles of the run's body.

`bayes-body simulate --body` and `bayes-body mocap` write them: the angles with which this body follows the motion. Angles are compared on the circle.
Those of a joint that comes near gimbal lock are left out.
"""

from dataclasses import replace
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int
from numpy.typing import NDArray

from bayes_body.base.errors import input_error
from bayes_body.base.files.arrays_file import read_arrays
from bayes_body.model.body.placement import ByAngles
from bayes_body.model.build import Model
from bayes_body.recording.session.session import Session
from bayes_body.results.clinical.joints import joint_frames, joints_of
from bayes_body.results.clinical.moments import laboratory_of
from bayes_body.results.clinical.trajectories import TURN, determined
from bayes_body.results.metrics.accuracy import LEVELS, inside_intervals
from bayes_body.results.metrics.clouds import Clouds, weights_of

KIND = "an .npz with `angles` (frame, dof), radians and metres, `dof_names` and `body`"
REMEDY = "write it with `bayes-body simulate --body` or `bayes-body mocap`"


class TrueAngles(NamedTuple):
    """True poses of a body in each frame, radians and metres, and the index of the world's axis that points up."""

    poses: Float[np.ndarray, "frame dof"]
    up: int

    def select(self, frames: range) -> "TrueAngles":
        """Return those of some frames."""
        return self._replace(poses=self.poses[frames.start : frames.stop : frames.step])


class AngleAccuracy(NamedTuple):
    """Clinical angles compared with the true ones.

    Attributes:
        names: names of the angles with their sides.
        error_deg: weighted mean of the difference from the truth, degrees.
        inside: number of frames and runs in which the truth is inside the interval of each of LEVELS.
    """

    names: tuple[str, ...]
    error_deg: Float[np.ndarray, "frame run angle"]
    inside: Int[np.ndarray, "level angle"]

    @property
    def rms_deg(self) -> Float[np.ndarray, " angle"]:
        """Root mean square error of each angle, over frames and runs, degrees."""
        return np.sqrt((self.error_deg**2).mean(axis=(0, 1)))

    @property
    def coverage(self) -> Float[np.ndarray, "level angle"]:
        """Fraction of frames and runs with the truth inside, for each of LEVELS."""
        frames, runs, _ = self.error_deg.shape
        return self.inside / (frames * runs)


def true_angles(session: Session, model: Model) -> TrueAngles | None:
    """Return the true poses of the model's body in the session's frames; None if the session's truth has none of this body.

    Raises:
        InputError: the file that the session names cannot be used.
    """
    if session.truth_path is None:
        return None
    arrays = read_arrays(session.truth_path, ("angles", "dof_names", "body"), KIND, REMEDY)
    if len(arrays) < 3 or str(arrays["body"]) != model.body.name or tuple(arrays["dof_names"].astype(str).ravel()) != model.body.dof_names:
        return None
    angles, frames = arrays["angles"], session.skipped + session.frames
    if angles.dtype.kind != "f" or angles.ndim != 2 or angles.shape[1] != len(model.body.dof_names) or len(angles) < frames:
        expected = f"numbers of shape (frame, {len(model.body.dof_names)}), with at least {frames} frames"
        raise input_error(f"{session.truth_path}: angles", f"{angles.dtype} of shape {angles.shape}", expected, REMEDY)
    poses = angles[session.skipped : frames].astype(np.float64)
    if not np.isfinite(poses).all():
        raise input_error(f"{session.truth_path}: angles", "a number that is not finite", "finite numbers", REMEDY)
    return TrueAngles(poses, "xyz".index(session.up))


def angles_against_truth(model: Model, clouds: Clouds, truth: TrueAngles) -> AngleAccuracy | None:
    """Compare the clinical angles of particles with the true ones, one frame at a time; None for a body without clinical angles.

    Args:
        model: the run's model.
        clouds: returns a new iterator over the particles of each frame at each call.
        truth: the true poses in the same frames.
    """
    body = model.body
    joints = joints_of(body, model.definition.body.clinical, laboratory_of(truth.up))
    if not joints:
        return None
    # The truth is in angles, whatever variable places the model's body.
    posed = replace(body, placement=ByAngles())
    rotations = np.asarray(joint_frames(posed, jnp.asarray(truth.poses, body.lengths.dtype)).rotation, float)
    true = [np.degrees(joint.angles(rotations)) for joint in joints]
    columns = [determined(joint, degrees) for joint, degrees in zip(joints, true, strict=True)]
    true_deg = np.concatenate([degrees[:, chosen] for degrees, chosen in zip(true, columns, strict=True)], axis=1)

    def angles_of(poses: NDArray[np.floating]) -> Float[np.ndarray, "particle angle"]:
        rotations = np.asarray(joint_frames(body, jnp.asarray(poses, body.lengths.dtype)).rotation)
        return np.degrees(np.concatenate([joint.angles(rotations)[:, chosen] for joint, chosen in zip(joints, columns, strict=True)], axis=1))

    errors, inside = [], np.zeros((len(LEVELS), true_deg.shape[1]), int)
    for cloud, frame_deg in zip(clouds(), true_deg, strict=True):
        error = []
        for poses, log_weights in zip(cloud.poses, cloud.log_weights, strict=True):
            weights = weights_of(log_weights)
            off = (angles_of(poses) - frame_deg + TURN / 2) % TURN - TURN / 2
            error.append(weights @ off)
            inside += inside_intervals(off[..., None], weights, np.zeros((off.shape[1], 1)))[..., 0]
        errors.append(error)
    names = tuple(joint.names[k] for joint, chosen in zip(joints, columns, strict=True) for k in chosen)
    return AngleAccuracy(names, np.array(errors), inside)
