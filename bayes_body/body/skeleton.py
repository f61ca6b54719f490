r"""A tree of joints. $T_{world,j} = T_{world,parent(j)} \cdot P_j \cdot D_j(s)$: a fixed preset and offset P, then the joint's own dofs in order."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from bayes_body import geometry
from bayes_body.geometry import Transform
from bayes_body.shapes import Pose, Rotation, Scalar


class Motion(NamedTuple):
    """One dof of a joint: which axis it turns about or shifts along, in which sense, and which entry of the pose it reads."""

    dof: int
    axis: int
    sign: int
    is_shift: bool


@dataclass(frozen=True)
class Topology:
    """The static side of a skeleton: hashable, so that a new subject of the same body compiles nothing anew."""

    joint_names: tuple[str, ...]
    parents: tuple[int, ...]
    motions: tuple[tuple[Motion, ...], ...]
    dof_names: tuple[str, ...]
    dof_units: tuple[str, ...]

    @property
    def angular(self) -> tuple[bool, ...]:
        """For each dof, whether it is an angle (radians) and not a shift (metres)."""
        return tuple(unit == "rad" for unit in self.dof_units)


@partial(jax.tree_util.register_dataclass, meta_fields=["topology"], data_fields=["presets", "offsets", "low", "high"])
@dataclass(frozen=True)
class Skeleton:
    """Joints as arrays: `presets` and `offsets` (metres) of each joint in its parent's frame; limits of each dof, radians or metres, or infinite."""

    topology: Topology
    presets: Float[Array, "joint 3 3"]
    offsets: Float[Array, "joint 3"]
    low: Float[Array, " dof"]
    high: Float[Array, " dof"]


def forward_kinematics(skeleton: Skeleton, pose: Pose) -> tuple[Transform, ...]:
    """`T_world_joint` of every joint, parents before children.

    Args:
        skeleton: joints of the body.
        pose: radians and metres, in the order of `topology.dof_names`.
    """
    # lax.split, not indexing: its transpose is one concatenation where every index's is a padded sum.
    values, cos, sin = (_entries(entries) for entries in (pose, jnp.cos(pose), jnp.sin(pose)))
    transforms: list[Transform] = []
    topology = skeleton.topology
    for j, (parent, motions) in enumerate(zip(topology.parents, topology.motions, strict=True)):
        above = transforms[parent] if parent >= 0 else geometry.identity(pose.dtype)
        T = geometry.compose(above, skeleton.presets[j], skeleton.offsets[j])
        for motion in motions:
            k = motion.dof
            if motion.is_shift:
                T = geometry.shift(T, motion.axis, motion.sign * values[k])
            else:
                T = geometry.turn(T, motion.axis, cos[k], motion.sign * sin[k])
        # Without the barrier XLA writes the chain of all joints above anew into every fusion that reads this one: twice the time, five times the
        # compilation.
        transforms.append(Transform(*jax.lax.optimization_barrier(tuple(T))))
    return tuple(transforms)


def _entries(vector: Pose) -> list[Scalar]:
    return [entry[0] for entry in jax.lax.split(vector, [1] * vector.shape[0])]


@partial(jax.tree_util.register_dataclass, meta_fields=["joints", "names"], data_fields=["offsets"])
@dataclass(frozen=True)
class Markers:
    """Virtual markers: points of joint frames, metres."""

    names: tuple[str, ...]
    joints: tuple[int, ...]
    offsets: Float[Array, "marker 3"]


def marker_positions(skeleton: Skeleton, markers: Markers, pose: Pose) -> Float[Array, "marker 3"]:
    """World positions of the virtual markers, metres."""
    transforms = forward_kinematics(skeleton, pose)
    return jnp.stack([geometry.apply(transforms[j], markers.offsets[m]) for m, j in enumerate(markers.joints)])


def preset_rotation(names: Sequence[str]) -> Rotation:
    """The product of fixed rotations such as `x90` (about an axis, right-handed, in degrees), exact to the last bit."""
    T = geometry.identity(jnp.zeros(0).dtype)
    for name in names:
        axis, quarter = "xyz".index(name[0]), int(name[1:]) // 90
        cos, sin = [(1.0, 0.0), (0.0, 1.0), (-1.0, 0.0), (0.0, -1.0)][quarter]
        T = geometry.turn(T, axis, jnp.asarray(cos), jnp.asarray(sin))
    return jnp.stack([T.x, T.y, T.z], axis=1)
