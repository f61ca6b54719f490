"""The joints of a body whose angles can be read: between two segments of its table `[clinical]`, without the angles that the body holds fixed."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from bayes_body.base.geometry.transforms import Transform
from bayes_body.model.body.placed_body import joint_transforms
from bayes_body.model.body.placement import ByParts
from bayes_body.model.body.solids import Body
from bayes_body.model.body.tables import Segment
from bayes_body.results.clinical.conventions import CLINICAL, LABORATORY, Convention, Side, angles_of

# Random configurations on which it is seen which angles a body can change, and the change that counts, radians.
TRIALS, CHANGE = 64, 1e-3


class Joint(NamedTuple):
    """A joint of a body.

    Attributes:
        convention: its angles.
        side: its side.
        proximal: index of the joint of the skeleton that carries the proximal segment; -1 for the laboratory.
        distal: that of the distal segment.
        proximal_axes: rotation from the segment's anatomical axes to that joint's frame; from the laboratory's to the world's.
        distal_axes: that of the distal segment.
        free: which of the three angles the body can change.
    """

    convention: Convention
    side: Side
    proximal: int
    distal: int
    proximal_axes: Float[np.ndarray, "3 3"]
    distal_axes: Float[np.ndarray, "3 3"]
    free: tuple[int, ...] = (0, 1, 2)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the free angles."""
        return tuple(self.convention.names(self.side)[k] for k in self.free)

    @property
    def coordinates(self) -> tuple[str, ...]:
        """OpenSim's names of the free angles, empty where there is none."""
        return tuple(self.convention.coordinates(self.side)[k] for k in self.free)

    def angles(self, rotations: Float[np.ndarray, "*batch joint 3 3"]) -> Float[np.ndarray, "*batch angle"]:
        """Return the free angles, radians, from the rotations of all joints of the skeleton."""
        proximal = self.proximal_axes if self.proximal < 0 else rotations[..., self.proximal, :, :] @ self.proximal_axes
        R = np.swapaxes(proximal, -1, -2) @ rotations[..., self.distal, :, :] @ self.distal_axes
        return angles_of(self.convention, self.side, R)[..., list(self.free)]


def axes_of(segment: Segment) -> Float[np.ndarray, "3 3"]:
    """Return the rotation from a segment's anatomical axes (x forward, y up, z to the right) to its joint's frame."""
    forward, up = (_direction(axis) for axis in (segment.forward, segment.up))
    return np.column_stack([forward, up, np.cross(forward, up)])


def joints_of(
    body: Body, segments: Mapping[str, Segment], laboratory: tuple[int, int, int], conventions: Sequence[Convention] = CLINICAL
) -> tuple[Joint, ...]:
    """Return the joints of a body between segments that its file names, if it can change at least one of their angles.

    Args:
        body: the body.
        segments: the table `[clinical]` of its file.
        laboratory: the world's axes that are the laboratory's x, y (up) and z.
        conventions: the conventions, in order.
    """
    index = body.skeleton.topology.joint_names.index
    joints = []
    for convention in conventions:
        for side in convention.sides:
            proximal, distal = convention.segments(side)
            if distal not in segments or (proximal != LABORATORY and proximal not in segments):
                continue
            below, axes = segments[distal], np.eye(3)[:, list(laboratory)]
            above = -1
            if proximal != LABORATORY:
                above, axes = index(segments[proximal].joint), axes_of(segments[proximal])
            joints.append(Joint(convention, side, above, index(below.joint), axes, axes_of(below)))
    if not joints:
        return ()
    rotations = np.asarray(joint_frames(body, _trials(body)).rotation, float)
    freed = [joint._replace(free=_changing(joint.angles(rotations))) for joint in joints]
    return tuple(joint for joint in freed if joint.free)


@jax.jit
def joint_frames(body: Body, configurations: Float[Array, "draw *shape"]) -> Transform:
    """Return `T_world_joint` of every joint of many configurations: rotations (draw, joint, 3, 3) and origins (draw, joint, 3), metres."""
    return jax.vmap(joint_transforms, (None, 0))(body, configurations)


def _direction(axis: str) -> Float[np.ndarray, "3"]:
    return np.eye(3)["xyz".index(axis[-1])] * (-1.0 if axis.startswith("-") else 1.0)


def _trials(body: Body) -> Float[Array, "trial *shape"]:
    """Return random configurations of a body; of a loose-limbed one the parts turn on their own."""
    rng, placement, skeleton = np.random.default_rng(0), body.placement, body.skeleton
    if isinstance(placement, ByParts):
        q = rng.normal(size=(TRIALS, len(placement.names), 4))
        parts = np.concatenate([np.zeros((*q.shape[:2], 3)), q / np.linalg.norm(q, axis=-1, keepdims=True)], axis=-1)
        return jnp.asarray(parts, skeleton.offsets.dtype)
    low, high = (np.clip(np.asarray(limits, float), -1.0, 1.0) for limits in (skeleton.low, skeleton.high))
    return jnp.asarray(rng.uniform(low, high, (TRIALS, len(low))), skeleton.offsets.dtype)


def _changing(angles: Float[np.ndarray, "trial angle"]) -> tuple[int, ...]:
    moved = np.maximum(np.ptp(np.sin(angles), axis=0), np.ptp(np.cos(angles), axis=0)) > CHANGE
    return tuple(np.flatnonzero(moved).tolist())
