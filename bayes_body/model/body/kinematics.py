r"""Forward kinematics of all joints at once: $T_{world,j} = T_{world,parent(j)} \cdot P_j \cdot D_j(s)$, and its derivative in closed form.

First every joint moves in its parent's frame: the k-th rotations of all joints are computed together. Then each frame is composed with its parent's,
the result with the grandparent's and so on, doubling the distance each time: three rounds for a person. Joint by joint, compilation takes three times
as long. A dof k that rotates about the axis $a_k$ through $q_k$ (unit vector and metres, world) moves everything below it with the angular velocity
$\omega = a_k \dot s_k$ and, at p, the velocity $\omega \times (p - q_k)$; one that translates along $a_k$, with the velocity $a_k \dot s_k$. The
change of a frame is the sum over the dofs that move it (Featherstone, Rigid Body Dynamics Algorithms, ch. 2): a matrix product, and so is the
gradient.
"""

from functools import lru_cache, partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.custom_derivatives import SymbolicZero
from jaxtyping import Array, Bool, Float, Int

from bayes_body.base.geometry import transforms
from bayes_body.base.geometry.transforms import Transform
from bayes_body.base.shapes import Pose
from bayes_body.model.body.skeleton import Markers, Motion, Skeleton, Topology

# Without this, some accelerators round the factors of a matrix product to ten bits.
EXACT = jax.lax.Precision.HIGHEST
# Programs are cached, so indices must be 32 bits wide: JAX rejects in double precision a 64-bit index that it traced in single precision.
INDEX = np.int32


@jax.custom_jvp
def forward_kinematics(skeleton: Skeleton, pose: Pose) -> Transform:
    """`T_world_joint` of every joint, stacked: rotations (joint, 3, 3) and origins (joint, 3), metres.

    Args:
        skeleton: the body's joints.
        pose: radians and metres, in the order of `topology.dof_names`.
    """
    return _frames(skeleton, pose)[0]


def marker_positions(skeleton: Skeleton, markers: Markers, pose: Pose) -> Float[Array, "marker 3"]:
    """World positions of the virtual markers, metres."""
    joints = transforms.pick(forward_kinematics(skeleton, pose), np.array(markers.joints, INDEX))
    return transforms.apply(joints, markers.offsets)


# -- the program of a topology ----------------------------------------------------------------------------------------------------------


class _Shifts(NamedTuple):
    """How joints translate along their axes: the sum over n of pose[dofs[n]] * signs[n]; a sign of 0 means no translation."""

    dofs: Int[np.ndarray, "n joint 3"]
    signs: Float[np.ndarray, "n joint 3"]


class _Turns(NamedTuple):
    """The k-th rotation of every joint: cos(angle) * cos + sin(angle) * sin + constant. Joints without one have the identity in `constant`."""

    dofs: Int[np.ndarray, " joint"]
    cos: Float[np.ndarray, "joint 3 3"]
    sin: Float[np.ndarray, "joint 3 3"]
    constant: Float[np.ndarray, "joint 3 3"]


class _Program(NamedTuple):
    """The kinematics of a topology.

    Attributes:
        shifts: those before each rotation and after the last one; None where no joint has any.
        turns: the rotations, in order.
        ancestors: for each round, the frame with which a joint's is composed; -1 for none.
        moves: (joint, dof); 1 if the dof moves the joint.
        joint, turns_before, axis, sign, shift: for each dof, its joint, the number of its joint's rotations before it, and its effect.
    """

    shifts: tuple[_Shifts | None, ...]
    turns: tuple[_Turns, ...]
    ancestors: tuple[Int[np.ndarray, " joint"], ...]
    moves: Float[np.ndarray, "joint dof"]
    joint: Int[np.ndarray, " dof"]
    turns_before: Int[np.ndarray, " dof"]
    axis: Int[np.ndarray, " dof"]
    sign: Float[np.ndarray, " dof"]
    shift: Bool[np.ndarray, " dof"]


@lru_cache
def _program(topology: Topology) -> _Program:
    joints, dofs = len(topology.parents), len(topology.dof_names)
    most = max(sum(not motion.is_shift for motion in motions) for motions in topology.motions)
    shifts, turns = np.zeros((most + 1, joints, 3, dofs)), [_no_turns(joints) for _ in range(most)]
    joint, turns_before = np.zeros(dofs, INDEX), np.zeros(dofs, INDEX)
    moves = np.zeros((joints, dofs))
    for j, motions in enumerate(topology.motions):
        turned = 0
        for motion in motions:
            joint[motion.dof], turns_before[motion.dof], moves[j, motion.dof] = j, turned, 1
            if motion.is_shift:
                shifts[turned, j, motion.axis, motion.dof] = motion.sign
            else:
                _write(turns[turned], j, motion)
                turned += 1
    rounds = _rounds(topology.parents)
    for ancestor in rounds:
        moves += np.where(ancestor[:, None] >= 0, moves[ancestor], 0)
    _, axis, sign, shift = (np.array(column) for column in zip(*sorted(motion for motions in topology.motions for motion in motions), strict=True))
    return _Program(tuple(map(_shifts, shifts)), tuple(turns), rounds, moves, joint, turns_before, axis.astype(INDEX), sign, shift)


def _shifts(signs: Float[np.ndarray, "joint 3 dof"]) -> _Shifts | None:
    most = np.count_nonzero(signs, axis=-1).max()
    dofs = np.argsort(signs == 0, axis=-1, kind="stable")[..., :most].astype(INDEX)
    return _Shifts(*(np.moveaxis(array, -1, 0) for array in (dofs, np.take_along_axis(signs, dofs, axis=-1)))) if most else None


def _no_turns(joints: int) -> _Turns:
    cos, sin = np.zeros((2, joints, 3, 3))
    return _Turns(np.zeros(joints, INDEX), cos, sin, np.tile(np.eye(3), (joints, 1, 1)))


def _write(turns: _Turns, joint: int, motion: Motion) -> None:
    i, k = (motion.axis + 1) % 3, (motion.axis + 2) % 3
    turns.dofs[joint] = motion.dof
    turns.constant[joint, i, i] = turns.constant[joint, k, k] = 0
    turns.cos[joint, i, i] = turns.cos[joint, k, k] = 1
    turns.sin[joint, k, i], turns.sin[joint, i, k] = motion.sign, -motion.sign


def _rounds(parents: tuple[int, ...]) -> tuple[Int[np.ndarray, " joint"], ...]:
    """For each round, the ancestors with whose frames the joints' are composed: parents first, then twice as far each time, up to the world."""
    rounds, above = [], np.array(parents, INDEX)
    while (above >= 0).any():
        rounds.append(above)
        above = np.where(above >= 0, above[above], -1)
    return tuple(rounds)


# -- frames and their changes -----------------------------------------------------------------------------------------------------------


def _frames(skeleton: Skeleton, pose: Pose) -> tuple[Transform, list[Transform]]:
    """Every joint in the world, and in its parent's frame before each of its rotations and after them."""
    program = _program(skeleton.topology)
    stages = _stages(skeleton, program, pose)
    T = stages[-1]
    for ancestor in program.ancestors:
        # Without barriers XLA copies all earlier rounds into every reader of this one. A single barrier for both could not be transposed when only
        # lengths are differentiated.
        T = jax.tree.map(jax.lax.optimization_barrier, T)
        T = transforms.compose(_above(T, ancestor), T)
    return T, stages


def _stages(skeleton: Skeleton, program: _Program, pose: Pose) -> list[Transform]:
    cos, sin = jnp.cos(pose), jnp.sin(pose)
    T = Transform(skeleton.presets, skeleton.offsets)
    stages: list[Transform] = []
    for k, shifts in enumerate(program.shifts):
        if shifts is not None:
            T = T._replace(origin=transforms.apply(T, jnp.sum(pose[shifts.dofs] * shifts.signs.astype(pose.dtype), axis=0)))
        stages.append(T)
        if k < len(program.turns):
            dofs, *parts = program.turns[k]
            c, s, constant = (part.astype(pose.dtype) for part in parts)
            turned = cos[dofs][:, None, None] * c + sin[dofs][:, None, None] * s + constant
            T = T._replace(rotation=transforms.multiply(T.rotation, turned))
    return stages


def _above(T: Transform, ancestor: Int[np.ndarray, " joint"]) -> Transform:
    """The frames of the ancestors; the world's if there is none."""
    has_ancestor = (ancestor >= 0)[:, None]
    frames = transforms.pick(T, np.maximum(ancestor, 0))
    eye = jnp.eye(3, dtype=T.origin.dtype)
    return Transform(jnp.where(has_ancestor[..., None], frames.rotation, eye), jnp.where(has_ancestor, frames.origin, 0))


@partial(forward_kinematics.defjvp, symbolic_zeros=True)
def _change(primals: tuple[Skeleton, Pose], tangents: tuple[Skeleton, Any]) -> tuple[Transform, Transform]:
    skeleton, pose = primals
    T, stages = _frames(skeleton, pose)
    change = jax.tree.map(jnp.zeros_like, T)
    if not _is_zero(tangents[1]):
        change = _by_pose(skeleton.topology, T, stages, jnp.asarray(tangents[1]))
    if not all(_is_zero(leaf) for leaf in jax.tree.leaves(tangents[0], is_leaf=_is_zero)):
        lengths = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype) if _is_zero(leaf) else leaf, tangents[0], is_leaf=_is_zero)
        by_lengths = jax.jvp(lambda primal: _frames(primal, pose)[0], (skeleton,), (lengths,))[1]
        change = jax.tree.map(jnp.add, change, by_lengths)
    return T, change


def _is_zero(tangent: Any) -> bool:
    """Whether a tangent marks an argument that is not differentiated."""
    return isinstance(tangent, SymbolicZero)


def _by_pose(topology: Topology, T: Transform, stages: list[Transform], speed: Pose) -> Transform:
    """How the frames change with the dofs (formula of the module)."""
    program, dtype = _program(topology), speed.dtype
    above = transforms.pick(_above(T, np.array(topology.parents, INDEX)), program.joint)
    rotations, origins = (jnp.stack(column) for column in zip(*stages, strict=True))
    axis = transforms.turn(above.rotation, rotations[program.turns_before, program.joint, :, program.axis])
    place = transforms.apply(above, origins[program.turns_before, program.joint])
    step = (program.sign.astype(dtype) * speed)[:, None] * axis
    shifts = program.shift[:, None]
    # Angular velocity, and the velocity of the point at the world's origin.
    twists = jnp.concatenate([jnp.where(shifts, 0, step), jnp.where(shifts, step, jnp.cross(place, step))], axis=1)
    spin, drift = jnp.split(jnp.tensordot(program.moves.astype(dtype), twists, 1, precision=EXACT), 2, axis=1)
    return Transform(jnp.cross(spin[:, :, None], T.rotation, axis=1), jnp.cross(spin, T.origin) + drift)
