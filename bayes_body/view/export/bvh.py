r"""BVH, the skeleton format of animation programs: the hierarchy of the body's joints, and the posterior's mean pose in every frame; centimetres.

At rest (all rotations zero) the skeleton is in the body's zero pose, and the joints' axes are parallel to those of the world. With $R_j$ a joint's
rotation and $R^0_j$ its rotation in the zero pose, the file contains $W_j = R_j {R^0_j}^T$, relative to the parent's. The mean pose is the mean of
the joint angles, from which the joints' positions follow. So bones keep their lengths, unlike in a mean of positions. Of a loose-limbed body it is
the mean transform of each part: the joint of a part has six channels, so that the gaps between the parts are kept. The format cannot store
uncertainty.
"""

import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from scipy.spatial.transform import Rotation

from bayes_body.base.errors import input_error
from bayes_body.base.files.atomic import replacing
from bayes_body.base.geometry.transforms import Transform
from bayes_body.model.body.placed_body import joint_transforms
from bayes_body.model.body.placement import ByParts
from bayes_body.model.body.solids import Body
from bayes_body.view.export.motion import LongMotion, Motion

CENTIMETRES = 100.0
# Rotations about the joint's own axes, in this order.
EULER = "ZXY"
POSITIONS = "Xposition Yposition Zposition"
ROTATIONS = " ".join(f"{axis}rotation" for axis in EULER)
# Length of the bone that programs draw at a last joint without a marker beyond it.
STUB_M = 0.05


class Joints(NamedTuple):
    """The body's joints in the file's axes, depth first.

    Attributes:
        names: names of the joints.
        parents: index of each joint's parent; -1 for the root.
        moving: which joints shift relative to their parent, including the root; of a loose-limbed body the joints of all parts.
        offsets: (joint, 3), from the parent at rest, metres; 0 for the root.
        ends: (joint, 3), from a last joint to the end of its bone, at rest, metres; NaN for other joints.
        positions: (frame, joint, 3), from the parent, in the parent's axes, metres.
        angles: (frame, joint, 3), degrees, in the order of `EULER`.
    """

    names: tuple[str, ...]
    parents: tuple[int, ...]
    moving: tuple[bool, ...]
    offsets: Float[np.ndarray, "joint 3"]
    ends: Float[np.ndarray, "joint 3"]
    positions: Float[np.ndarray, "frame joint 3"]
    angles: Float[np.ndarray, "frame joint 3"]


def write_bvh(motion: Motion | LongMotion, path: Path) -> None:
    """Write the file; centimetres and degrees have six decimals.

    Raises:
        InputError: the body does not have exactly one root, or the file system does not accept the file.
    """
    with replacing(path) as partial, partial.open("w", encoding="utf-8", newline="\n") as file:
        previous = None
        for block in motion.blocks():
            joints = joints_of(block, previous)
            previous, moving = joints.angles[-1], joints.moving
            if not block.skipped:
                file.write("HIERARCHY\n" + "\n".join(_hierarchy(joints, 0, "")) + "\n")
                file.write(f"MOTION\nFrames: {motion.frames}\nFrame Time: {1 / motion.fps:.10g}\n")
            places = [joints.positions[:, j] * CENTIMETRES if moving[j] else joints.positions[:, j, :0] for j in range(len(moving))]
            columns = [part for j, place in enumerate(places) for part in (place, joints.angles[:, j])]
            # Adding 0 turns -0 into 0, here and below.
            np.savetxt(file, np.round(np.concatenate(columns, axis=1), 6) + 0.0, fmt="%.6f")


def joints_of(motion: Motion, previous: Float[np.ndarray, "joint 3"] | None = None) -> Joints:
    """Return the mean pose as a hierarchy of joints.

    Args:
        motion: some frames of a motion.
        previous: the angles in the frame before them, from which the angles go on.

    Raises:
        InputError: the body does not have exactly one root.
    """
    body = motion.body
    order = _depth_first(body)
    topology, placement = body.skeleton.topology, body.placement
    # The name of a joint between a free and a fixed angle has a space, which would end it in the file.
    names, above = tuple(topology.joint_names[j].replace(" ", "_") for j in order), [topology.parents[j] for j in order]
    parents = tuple(order.index(parent) if parent >= 0 else -1 for parent in above)
    rotations, places = _placed(motion)
    R, origins, R_rest, rest_places = rotations[:-1, order], places[:-1, order], rotations[-1, order], places[-1, order]
    shifting = {j for j, motions in enumerate(topology.motions) if any(dof.is_shift for dof in motions)}
    free = placement.joints_of_parts if isinstance(placement, ByParts) else shifting
    moving = tuple(parent < 0 or j in free for j, parent in zip(order, parents, strict=True))
    W = R @ np.swapaxes(R_rest, -1, -2)
    local, positions, offsets = W.copy(), origins.copy(), np.zeros_like(rest_places)
    for j, parent in enumerate(parents):
        if parent >= 0:
            back = np.swapaxes(W[:, parent], -1, -2)
            local[:, j], offsets[j] = back @ W[:, j], rest_places[j] - rest_places[parent]
            positions[:, j] = (back @ (origins[:, j] - origins[:, parent])[..., None])[..., 0]
    return Joints(names, parents, moving, offsets, _ends(body, order, R_rest), positions, _euler(local, previous))


def _depth_first(body: Body) -> list[int]:
    """Return the joints in the order in which the format nests them."""
    parents = body.skeleton.topology.parents
    roots = [j for j, parent in enumerate(parents) if parent < 0]
    if len(roots) != 1:
        raise input_error("--to bvh", f"the body '{body.name}' has {len(roots)} roots", "exactly one root", "use npz, csv, c3d or trc")
    order, stack = [], roots
    while stack:
        order.append(stack.pop())
        stack += [j for j in range(len(parents) - 1, -1, -1) if parents[j] == order[-1]]
    return order


def _placed(motion: Motion) -> tuple[Float[np.ndarray, "pose joint 3 3"], Float[np.ndarray, "pose joint 3"]]:
    """Return the rotations and origins of the joints in the file's axes: in every frame, and last in the zero pose."""
    body, zero = motion.body, np.zeros(len(motion.body.dof_names))
    if motion.parts is not None:
        zero = np.asarray(body.placement.configuration(body.skeleton, jnp.asarray(zero)))
        configurations = motion.parts.mean
    else:
        configurations = motion.dofs.mean * np.where(np.array(motion.dof_units) == "deg", np.pi / 180, 1.0)
    rotations, origins = _transforms(body, jnp.asarray(np.concatenate([configurations, zero[None]])))
    return np.asarray(rotations, float), np.asarray(origins, float)


@jax.jit
def _transforms(body: Body, configurations: Float[Array, "pose *shape"]) -> Transform:
    return jax.vmap(joint_transforms, (None, 0))(body, configurations)


def _ends(body: Body, order: list[int], R_rest: Float[np.ndarray, "joint 3 3"]) -> Float[np.ndarray, "joint 3"]:
    """Return the end of each last joint's bone: its farthest marker, such as the wrist beyond the elbow, or else a stub along its z axis."""
    ends = np.full((len(order), 3), np.nan)
    offsets, joints = np.asarray(body.markers.offsets, float).reshape(-1, 3), np.array(body.markers.joints, int)
    for row, j in enumerate(order):
        if j not in body.skeleton.topology.parents:
            joint_offsets = offsets[joints == j]
            farthest = max(joint_offsets, key=np.linalg.norm, default=np.zeros(3))
            ends[row] = R_rest[row] @ (farthest if np.linalg.norm(farthest) > 0 else np.array([0.0, 0.0, STUB_M]))
    return ends


def _euler(local: Float[np.ndarray, "frame joint 3 3"], previous: Float[np.ndarray, "joint 3"] | None) -> Float[np.ndarray, "frame joint 3"]:
    """Return Euler angles in degrees, without jumps of whole turns from frame to frame."""
    with warnings.catch_warnings():
        # If the middle angle is a quarter turn, only one combination of the other two matters: every choice gives the same rotation.
        warnings.filterwarnings("ignore", message="Gimbal lock")
        angles = Rotation.from_matrix(local.reshape(-1, 3, 3)).as_euler(EULER).reshape(local.shape[:3])
    path = angles if previous is None else np.concatenate([np.radians(previous)[None], angles])
    return np.degrees(np.unwrap(path, axis=0)[len(path) - len(angles) :])


def _hierarchy(joints: Joints, j: int, indent: str) -> Iterator[str]:
    inner = f"{indent}\t"
    yield f"{indent}{'ROOT' if joints.parents[j] < 0 else 'JOINT'} {joints.names[j]}"
    yield f"{indent}{{"
    yield f"{inner}OFFSET {_centimetres(joints.offsets[j])}"
    yield f"{inner}CHANNELS {f'6 {POSITIONS} ' if joints.moving[j] else '3 '}{ROTATIONS}"
    for child in (k for k, parent in enumerate(joints.parents) if parent == j):
        yield from _hierarchy(joints, child, inner)
    if not np.isnan(joints.ends[j]).any():
        yield from (f"{inner}End Site", f"{inner}{{", f"{inner}\tOFFSET {_centimetres(joints.ends[j])}", f"{inner}}}")
    yield f"{indent}}}"


def _centimetres(offset: Float[np.ndarray, "3"]) -> str:
    return " ".join(f"{value:.6f}" for value in np.round(CENTIMETRES * offset, 6) + 0.0)
