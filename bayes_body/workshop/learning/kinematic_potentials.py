"""Learn the kinematic potentials of a loose-limbed body (Sigal et al. 2011, (5), (6)) from captured motion of several people.

Each motion is retargeted to the body. Of all angles that place the markers alike those nearest to rest are taken, as for a walking cycle. The pose of
each part in its parent's frame follows, in the body with the person's own lengths. Its position is counted from where the joint is when all angles
are 0, so that people of different size agree. An equal number of frames of each motion is used. All motions of one person together have the same
weight as those of any other.
"""

from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from bayes_body.base.errors import input_error
from bayes_body.density.chart import relative_to_parents
from bayes_body.initial.retarget import retarget
from bayes_body.model.body.build import build_body
from bayes_body.model.body.placement import ByParts, loosened
from bayes_body.model.body.schema import BodySchema
from bayes_body.model.body.solids import Body
from bayes_body.model.potentials.joint_file import JointMixtures
from bayes_body.recording.readers.mocap import resample
from bayes_body.recording.readers.mocap.motion import Motion
from bayes_body.workshop.learning.joint_mixtures import Fitted, Floors, fit_mixture, log_density
from bayes_body.workshop.learning.walking_angles import FPS, settled_frames


class JointPoses(NamedTuple):
    """Relative poses of one motion: its name, the person, and every joint's pose (see `JointMixtures.mean`) in some frames."""

    name: str
    subject: str
    poses: Float[np.ndarray, "frame joint 7"]


class HeldOut(NamedTuple):
    """Mean log-densities of other frames, nats, by person and joint."""

    subjects: tuple[str, ...]
    values: Float[np.ndarray, "subject joint"]


def joints_of(body: str, schema: BodySchema) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Return the child and the parent of every joint of a loose-limbed body.

    Raises:
        InputError: the body cannot be placed by its parts, or has only one.
    """
    placement = loosened(build_body(body, schema)).placement
    assert isinstance(placement, ByParts)
    joints = [(name, placement.names[parent]) for name, parent in zip(placement.names, placement.parents, strict=True) if parent >= 0]
    if not joints:
        raise input_error(f"body '{body}'", "one part", "at least two parts, with a joint between them", "name another body")
    return tuple(part for part, _ in joints), tuple(parent for _, parent in joints)


def joint_poses(name: str, subject: str, motion: Motion, body: str, schema: BodySchema, frames: int) -> JointPoses:
    """Return the relative poses of a captured motion, in so many frames at equal distances. A shorter motion repeats some.

    Raises:
        InputError: the motion lacks points of the body.
    """
    motion = resample(motion, FPS)
    fit = retarget(build_body(body, schema), motion, schema=schema)
    chosen = np.linspace(0, len(fit.angles) - 1, frames).round().astype(int)
    angles = settled_frames(fit.body, fit.angles[chosen])
    return JointPoses(name, subject, relative_poses(fit.body, angles))


def relative_poses(body: Body, angles: Float[np.ndarray, "frame dof"]) -> Float[np.ndarray, "frame joint 7"]:
    """Return the pose of every joint at these angles: the position from where it is at angles of 0, metres, and the rotation."""
    parts = np.asarray(_relative(loosened(body), jnp.asarray(np.concatenate([np.zeros_like(angles[:1]), angles]), body.lengths.dtype)), float)
    parts[1:, :, :3] -= parts[:1, :, :3]
    return parts[1:]


@jax.jit
def _relative(body: Body, angles: Float[Array, "frame dof"]) -> Float[Array, "frame joint 7"]:
    placement = body.placement
    assert isinstance(placement, ByParts)
    children = np.array([child for child, parent in enumerate(placement.parents) if parent >= 0])
    place = jax.vmap(lambda pose: relative_to_parents(jnp.asarray(placement.configuration(body.skeleton, pose)), placement.parents))
    return place(angles)[:, children]


def learn_joints(motions: Sequence[JointPoses], body: str, schema: BodySchema, components: int, floors: Floors) -> JointMixtures:
    """Learn a mixture of so many components for each joint.

    Raises:
        InputError: the body cannot be placed by its parts.
    """
    parts, parents = joints_of(body, schema)
    poses, weights = np.concatenate([motion.poses for motion in motions]), _weights(motions)
    fits = [fit_mixture(poses[:, joint], weights, components, floors) for joint in range(len(parts))]
    mean, covariance, weight = (np.stack(values) for values in list(zip(*fits, strict=True))[:3])
    return JointMixtures(body, parts, parents, mean, covariance, weight)


def held_out(joints: JointMixtures, motions: Sequence[JointPoses]) -> HeldOut:
    """Return the mean log-density of the frames of motions, with all motions of a person counted alike."""
    fits = [Fitted(*values, 0.0) for values in zip(joints.mean, joints.covariance, joints.weight, strict=True)]
    log_densities = np.array([[log_density(fit, motion.poses[:, joint]).mean() for joint, fit in enumerate(fits)] for motion in motions])
    subjects = np.array([motion.subject for motion in motions])
    people = tuple(dict.fromkeys(subjects.tolist()))
    return HeldOut(people, np.stack([log_densities[subjects == person].mean(axis=0) for person in people]))


def _weights(motions: Sequence[JointPoses]) -> Float[np.ndarray, " draw"]:
    """Return weights that sum to 1: equal for each person, and for each motion of a person."""
    subjects = [motion.subject for motion in motions]
    of_motion = [1 / (len(set(subjects)) * subjects.count(motion.subject) * len(motion.poses)) for motion in motions]
    return np.concatenate([np.full(len(motion.poses), weight) for motion, weight in zip(motions, of_motion, strict=True)])
