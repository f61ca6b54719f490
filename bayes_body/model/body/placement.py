"""Placement: how one variable of a state places a body in the world.

`ByAngles` is the tree of joints: the variable `pose` has joint angles and the root's position. `ByParts` is the loose-limbed body (Sigal et al.
2011): the variable `parts` has one rigid transform for each part, and only the prior keeps the parts together. Likelihoods, markers and pictures take
a body and a configuration, the value of this variable. They do not know which of the two it is.
"""

from dataclasses import dataclass
from functools import partial
from typing import Protocol

import jax
import numpy as np

from bayes_body.base.geometry import rigid, transforms
from bayes_body.base.geometry.transforms import Transform
from bayes_body.base.shapes import Configuration, Pose
from bayes_body.model.body.kinematics import forward_kinematics
from bayes_body.model.body.skeleton import Skeleton

POSE, PARTS = "pose", "parts"
# The log-sizes of the parts, if they are unknown: variables of the state with a number for each part.
LENGTHS, WIDTHS = "lengths", "widths"


class Placement(Protocol):
    """How a configuration places the joints of a skeleton."""

    @property
    def variable(self) -> str:
        """The name of the variable whose value is the configuration."""
        ...

    def joints(self, skeleton: Skeleton, configuration: Configuration) -> Transform:
        """Return `T_world_joint` of every joint, stacked."""
        ...

    def configuration(self, skeleton: Skeleton, pose: Pose) -> Configuration:
        """Return the configuration in which the body stands as with these joint angles."""
        ...


@partial(jax.tree_util.register_dataclass, meta_fields=[], data_fields=[])
@dataclass(frozen=True)
class ByAngles:
    """A configuration is a pose: the entries of the skeleton's dofs (dof,), radians and metres."""

    @property
    def variable(self) -> str:
        """`pose`."""
        return POSE

    def joints(self, skeleton: Skeleton, configuration: Configuration) -> Transform:
        """Return `T_world_joint` by forward kinematics."""
        return forward_kinematics(skeleton, configuration)

    def configuration(self, skeleton: Skeleton, pose: Pose) -> Configuration:
        """Return the pose."""
        del skeleton
        return pose


@partial(jax.tree_util.register_dataclass, meta_fields=["names", "parents", "owners", "joints_of_parts"], data_fields=["T_part_joint"])
@dataclass(frozen=True)
class ByParts:
    """A configuration is the frame of every part in the world: (part, 7), metres and unit quaternions.

    A part is a joint that moves and carries solids, with all joints below it that do not. Its frame is that joint's frame.

    Attributes:
        names: the parts, each named after its first solid.
        parents: for each part the part to which it is attached, which comes earlier; -1 for the first.
        owners: for each joint of the skeleton the part that holds it.
        joints_of_parts: for each part its own joint.
        T_part_joint: the transform of every joint in the part that holds it.
    """

    names: tuple[str, ...]
    parents: tuple[int, ...]
    owners: tuple[int, ...]
    joints_of_parts: tuple[int, ...]
    T_part_joint: Transform

    @property
    def variable(self) -> str:
        """`parts`."""
        return PARTS

    def joints(self, skeleton: Skeleton, configuration: Configuration) -> Transform:
        """Return `T_world_joint`: each joint moves with the part that holds it."""
        del skeleton
        return transforms.compose(transforms.pick(rigid.to_transform(configuration), np.array(self.owners)), self.T_part_joint)

    def configuration(self, skeleton: Skeleton, pose: Pose) -> Configuration:
        """Return the frames of the parts of a body with these joint angles. Joints between parts that do not move count as bent by 0."""
        return _joint_frames(skeleton, pose, self.joints_of_parts)


@partial(jax.jit, static_argnames="joints")
def _joint_frames(skeleton: Skeleton, pose: Pose, joints: tuple[int, ...]) -> Configuration:
    return rigid.from_transform(transforms.pick(forward_kinematics(skeleton, pose), np.array(joints)))
