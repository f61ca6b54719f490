"""A tree of joints. Each has a fixed preset and offset in its parent's frame, then its own dofs in order (model/body/kinematics.py)."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Array, Float


class Motion(NamedTuple):
    """One dof of a joint: the axis of its rotation or translation, the sign (0: it moves nothing), and its index in the pose."""

    dof: int
    axis: int
    sign: int
    is_shift: bool


@dataclass(frozen=True)
class Topology:
    """The static side of a skeleton. It is hashable, so a new subject with the same body needs no new compilation."""

    joint_names: tuple[str, ...]
    parents: tuple[int, ...]
    motions: tuple[tuple[Motion, ...], ...]
    dof_names: tuple[str, ...]
    dof_units: tuple[str, ...]

    @property
    def angular(self) -> tuple[bool, ...]:
        """For each dof, whether it is an angle (radians) or not (metres)."""
        return tuple(unit == "rad" for unit in self.dof_units)


@partial(jax.tree_util.register_dataclass, meta_fields=["topology"], data_fields=["presets", "offsets", "low", "high"])
@dataclass(frozen=True)
class Skeleton:
    """Joints as arrays: `presets` and `offsets` (metres) of each in its parent's frame; limits of each dof, radians or metres, possibly infinite."""

    topology: Topology
    presets: Float[Array, "joint 3 3"]
    offsets: Float[Array, "joint 3"]
    low: Float[Array, " dof"]
    high: Float[Array, " dof"]


@partial(jax.tree_util.register_dataclass, meta_fields=["joints", "names"], data_fields=["offsets"])
@dataclass(frozen=True)
class Markers:
    """Virtual markers: points in joint frames, metres."""

    names: tuple[str, ...]
    joints: tuple[int, ...]
    offsets: Float[Array, "marker 3"]


def preset_rotation(names: Sequence[str]) -> Float[np.ndarray, "3 3"]:
    """The product of fixed rotations such as `x90` (about an axis, right-handed, in degrees), exact to the last bit."""
    R = np.eye(3)
    for name in names:
        i, k = (("xyz".index(name[0]) + step) % 3 for step in (1, 2))
        quarter = np.eye(3)
        quarter[[i, k]] = quarter[[k, i]] * [[-1], [1]]
        R = R @ np.linalg.matrix_power(quarter, int(name[1:]) // 90)
    return R
