"""Placement: how one variable of a state places a body in the world.

`ByAngles` is the tree of joints: the variable `pose` has joint angles and the root's position. `ByParts` is the loose-limbed body (Sigal et al.
2011): the variable `parts` has one rigid transform for each part, and only the prior keeps the parts together. Likelihoods, markers and pictures take
a body and a configuration, the value of this variable. They do not know which of the two it is.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Protocol

import jax
import jax.numpy as jnp
import numpy as np

from bayes_body.base.geometry import rigid, transforms
from bayes_body.base.geometry.transforms import Transform
from bayes_body.base.shapes import Configuration, Pose
from bayes_body.model.body.kinematics import forward_kinematics
from bayes_body.model.body.skeleton import Skeleton

POSE, PARTS = "pose", "parts"


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


@partial(jax.tree_util.register_dataclass, meta_fields=["names", "parents", "owners", "joints_of_parts"], data_fields=["held"])
@dataclass(frozen=True)
class ByParts:
    """A configuration is the frame of every part in the world: (part, 7), metres and unit quaternions.

    A part is a joint that moves and carries solids, with all joints below it that do not. Its frame is that joint's frame.

    Attributes:
        names: the parts, each named after its first solid.
        parents: for each part the part to which it is attached, which comes earlier; -1 for the first.
        owners: for each joint of the skeleton the part that holds it.
        joints_of_parts: for each part its own joint.
        held: `T_part_joint` of every joint in the part that holds it.
    """

    names: tuple[str, ...]
    parents: tuple[int, ...]
    owners: tuple[int, ...]
    joints_of_parts: tuple[int, ...]
    held: Transform

    @property
    def variable(self) -> str:
        """`parts`."""
        return PARTS

    def joints(self, skeleton: Skeleton, configuration: Configuration) -> Transform:
        """Return `T_world_joint`: each joint moves with the part that holds it."""
        del skeleton
        return transforms.compose(transforms.pick(rigid.to_transform(configuration), np.array(self.owners)), self.held)

    def configuration(self, skeleton: Skeleton, pose: Pose) -> Configuration:
        """Return the frames of the parts of a body with these joint angles. Joints between parts that do not move count as bent by 0."""
        return _joint_frames(skeleton, pose, self.joints_of_parts)


@partial(jax.jit, static_argnames="joints")
def _joint_frames(skeleton: Skeleton, pose: Pose, joints: tuple[int, ...]) -> Configuration:
    return rigid.from_transform(transforms.pick(forward_kinematics(skeleton, pose), np.array(joints)))


def loosened(body: "Body") -> "Body":
    """Return the body with one free rigid transform for each part, instead of joint angles.

    Raises:
        InputError: the first joint carries no solid, or a dof widens a part.
    """
    topology = body.skeleton.topology
    carries = set(body.topology.joints)
    if body.topology.widths:
        problem = f"a dof of the body '{body.name}' widens the part '{body.topology.names[body.topology.widths[0][0]]}'"
        raise input_error('[body] placement = "parts"', problem, "a body whose parts have fixed sizes", "take out the dofs of axis 'width'")
    if 0 not in carries:
        problem = f"the first joint of the body '{body.name}' carries no part"
        raise input_error('[body] placement = "parts"', problem, "a part on the first joint", 'add one, or take placement = "angles"')
    part_joints = [j for j, motions in enumerate(topology.motions) if j in carries and (motions or topology.parents[j] < 0)]
    owners = _owners(topology.parents, part_joints)
    names = tuple(body.topology.names[body.topology.joints.index(j)] for j in part_joints)
    parents = tuple(-1 if topology.parents[j] < 0 else owners[topology.parents[j]] for j in part_joints)
    return replace(body, placement=ByParts(names, parents, owners, tuple(part_joints), _joints_in_parts(body.skeleton, tuple(part_joints), owners)))


def _owners(parents: Sequence[int], part_joints: Sequence[int]) -> tuple[int, ...]:
    owners: list[int] = []
    for j, parent in enumerate(parents):
        owners.append(part_joints.index(j) if j in part_joints else owners[parent])
    return tuple(owners)


@partial(jax.jit, static_argnames=("part_joints", "owners"))
def _joints_in_parts(skeleton: Skeleton, part_joints: tuple[int, ...], owners: tuple[int, ...]) -> Transform:
    """Return every joint in its part's frame, with all angles at 0."""
    at_zero = forward_kinematics(skeleton, jnp.zeros(len(skeleton.topology.dof_names), skeleton.offsets.dtype))
    part = transforms.pick(at_zero, np.array(part_joints, np.int32)[list(owners)])
    inverse = jnp.swapaxes(part.rotation, -1, -2)
    return Transform(transforms.multiply(inverse, at_zero.rotation), transforms.turn(inverse, at_zero.origin - part.origin))
