r"""The axes of an exported file: a cyclic permutation of those of the session.

It is a rotation of the world, $x' = P x$. Markers and parts are turned with it. So is the body: the preset of its root becomes $P P_0$. The angles
of the root keep their values, and their axes turn: from z up to y up, the yaw about z is one about y. So standard deviations and quantiles stay
valid, and there is no gimbal lock that the session does not have. The root's positions are along the axes of the file: `root_x` along its x axis.
Forward kinematics of the turned body gives the turned markers.
"""

from collections.abc import Iterator
from dataclasses import replace
from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Float

from bayes_body.base.geometry import rigid, rotations
from bayes_body.base.geometry.namespaces import device_array
from bayes_body.model.body.skeleton import Motion, Skeleton
from bayes_body.model.body.solids import Body
from bayes_body.results.posterior.moments import Moments

type Axis = Literal["x", "y", "z"]
type Order = tuple[int, int, int]
AXES: tuple[Axis, ...] = ("x", "y", "z")


def order_of(axis: Axis, wanted: Axis) -> Order:
    """Return the session's axes that become x, y and z, if `axis` becomes `wanted`: a cyclic permutation, so moments still belong to single axes."""
    turn = AXES.index(axis) - AXES.index(wanted)
    return turn % 3, (1 + turn) % 3, (2 + turn) % 3


def turned_parts(parts: Float[np.ndarray, "*batch 7"], order: Order) -> Float[np.ndarray, "*batch 7"]:
    """Return rigid transforms in a world whose axes x, y and z are these of the given world."""
    turn = rotations.from_matrix(_matrix(order))
    return np.asarray(rigid.compose(rigid.rigid(np.zeros(3), turn), parts))


def turned_body(body: Body, order: Order) -> Body:
    """Return the body whose forward kinematics with the dofs of `turned_dofs` is in the turned world."""
    P, skeleton = _matrix(order), body.skeleton
    presets, offsets = np.array(skeleton.presets), np.array(skeleton.offsets)
    roots = np.array(skeleton.topology.parents) < 0
    presets[roots], offsets[roots] = P @ presets[roots], offsets[roots] @ P.T
    motions = list(skeleton.topology.motions)
    for j, shifts, directions in _root_positions(skeleton):
        # In the joint's own axes, which turned, the directions of the world did not.
        local = np.round(presets[j].T @ directions).astype(int)
        renamed = {shift.dof: shift._replace(axis=int(np.abs(a).argmax()), sign=int(a.sum())) for shift, a in zip(shifts, local.T, strict=True)}
        motions[j] = tuple(renamed.get(motion.dof, motion) for motion in motions[j])
    turned = replace(
        skeleton,
        topology=replace(skeleton.topology, motions=tuple(motions)),
        presets=device_array(presets, skeleton.presets.dtype),
        offsets=device_array(offsets, skeleton.offsets.dtype),
    )
    return replace(body, skeleton=turned)


def turned_dofs(dofs: Moments, body: Body, order: Order) -> Moments:
    """Return the moments of the dofs of a body (in the session's axes) with the root's positions along the axes of the turned world."""
    turned = Moments(*(np.array(values) for values in dofs))
    for _, shifts, directions in _root_positions(body.skeleton):
        columns = [shift.dof for shift in shifts]
        signs = directions.T @ _matrix(order) @ directions
        sources, negative = np.array(columns)[np.abs(signs).argmax(axis=1)], signs.sum(axis=1) < 0
        mean, sd, q05, q95 = (values[:, sources] for values in dofs)
        turned.mean[:, columns], turned.sd[:, columns] = np.where(negative, -mean, mean), sd
        turned.q05[:, columns], turned.q95[:, columns] = np.where(negative, [-q95, -q05], [q05, q95])
    return turned


def dof_axes(body: Body) -> Float[np.ndarray, "dof 3"]:
    """Return the axis of each dof in the zero pose, a unit vector in the world in which the body stands; 0 for a dof that moves no joint."""
    topology = body.skeleton.topology
    R, axes = np.array(body.skeleton.presets, float), np.zeros((len(topology.dof_names), 3))
    for j, (parent, motions) in enumerate(zip(topology.parents, topology.motions, strict=True)):
        R[j] = R[parent] @ R[j] if parent >= 0 else R[j]
        for motion in motions:
            axes[motion.dof] = motion.sign * R[j, :, motion.axis]
    # Adding 0 turns -0 into 0.
    return axes + 0.0


def stated_axes(body: Body) -> Iterator[tuple[int, Float[np.ndarray, "3"]]]:
    """Return the dofs of the root whose axes change with those of the world, and are not clear from their names: its angles, in their order."""
    topology, axes = body.skeleton.topology, dof_axes(body)
    named = {shift.dof for _, shifts, _ in _root_positions(body.skeleton) for shift in shifts}
    # Fixed dofs split a joint into several: `#1 root`, `root`.
    joints = [name.rpartition(" ")[2] for name in topology.joint_names]
    roots = {joint for joint, parent in zip(joints, topology.parents, strict=True) if parent < 0}
    for joint, motions in zip(joints, topology.motions, strict=True):
        yield from ((motion.dof, axes[motion.dof]) for motion in motions if joint in roots and motion.sign and motion.dof not in named)


def _matrix(order: Order) -> Float[np.ndarray, "3 3"]:
    return np.eye(3)[list(order)]


class _Positions(NamedTuple):
    """The three positions of a root: its joint, their motions, and their directions in the world (columns, of which each is an axis)."""

    joint: int
    motions: list[Motion]
    directions: Float[np.ndarray, "3 3"]


def _root_positions(skeleton: Skeleton) -> Iterator[_Positions]:
    """Return the positions of each joint without a parent that has all three before its angles, along the axes of the world."""
    for j, (parent, motions) in enumerate(zip(skeleton.topology.parents, skeleton.topology.motions, strict=True)):
        first = [motion for motion in motions if motion.sign][:3]
        if parent < 0 and len({motion.axis for motion in first if motion.is_shift}) == 3:
            directions = np.stack([motion.sign * np.asarray(skeleton.presets[j], float)[:, motion.axis] for motion in first], axis=1)
            # A fixed angle before them may turn them away from the axes.
            if np.allclose(np.abs(directions).max(axis=0), 1):
                yield _Positions(j, first, np.round(directions))
