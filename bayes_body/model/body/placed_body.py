"""A body and its placement: the body of loose parts, terms that need one placement, and where joints, markers and solids are in the world."""

from collections.abc import Sequence
from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from bayes_body.base.errors import input_error
from bayes_body.base.geometry import transforms
from bayes_body.base.geometry.transforms import Transform
from bayes_body.base.shapes import Configuration
from bayes_body.model.body.kinematics import forward_kinematics
from bayes_body.model.body.placement import PARTS, POSE, ByParts
from bayes_body.model.body.skeleton import Skeleton
from bayes_body.model.body.solids import Body


def loosened(body: Body) -> Body:
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


def require(body: Body, variable: str, subject: str, alternative: str) -> None:
    """Check that the body is placed by this variable.

    Args:
        body: the body.
        variable: `pose` or `parts`.
        subject: what needs it, such as "dynamics 'diffusion'".
        alternative: the term that does the same for the other placement.

    Raises:
        InputError: it is placed by the other one.
    """
    if body.variable != variable:
        placement = {POSE: "angles", PARTS: "parts"}
        setting, expected = f'[body] placement = "{placement[body.variable]}"', f'placement = "{placement[variable]}"'
        raise input_error(subject, setting, expected, f"change it, or take {alternative}")


@jax.jit
def solids_in_parts(body: Body) -> Transform:
    """Return `T_part_solid` of every solid of a body that is placed by parts: rotations (solid, 3, 3) and origins (solid, 3), metres."""
    placement = body.placement
    assert isinstance(placement, ByParts)
    return transforms.compose(transforms.pick(placement.T_part_joint, np.array(body.topology.joints)), Transform(body.presets, body.offsets))


def joint_transforms(body: Body, configuration: Configuration) -> Transform:
    """`T_world_joint` of every joint, stacked: rotations (joint, 3, 3) and origins (joint, 3), metres."""
    return body.placement.joints(body.skeleton, configuration)


def placed_markers(body: Body, configuration: Configuration) -> Float[Array, "marker 3"]:
    """World positions of the virtual markers, metres."""
    return transforms.apply(transforms.pick(joint_transforms(body, configuration), np.array(body.markers.joints, np.int32)), body.markers.offsets)
