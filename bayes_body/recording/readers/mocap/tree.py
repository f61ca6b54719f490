r"""Forward kinematics of joints over all frames at once: $R_j = R_{parent(j)} L_j$, $p_j = p_{parent(j)} + R_{parent(j)} o_j$."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float


def place(
    parents: Sequence[int], offsets: Float[np.ndarray, "frames joint 3"], local: Float[np.ndarray, "frame joint 3 3"]
) -> tuple[Float[np.ndarray, "frame joint 3"], Float[np.ndarray, "frame joint 3 3"]]:
    """World positions and rotations.

    Args:
        parents: index of each joint's parent, parents first; -1 for a root.
        offsets: each joint's position in its parent's frame (for a root: in the world), in each frame or in one frame for all.
        local: each joint's rotation in its parent's frame.
    """
    offsets = np.broadcast_to(offsets, local.shape[:3])
    positions, rotations = np.empty(local.shape[:3]), np.empty(local.shape)
    for j, parent in enumerate(parents):
        if parent < 0:
            positions[:, j], rotations[:, j] = offsets[:, j], local[:, j]
        else:
            above = rotations[:, parent]
            positions[:, j] = positions[:, parent] + (above @ offsets[:, j, :, None])[..., 0]
            rotations[:, j] = above @ local[:, j]
    return positions, rotations


def turns(axes: str, angles_deg: Float[np.ndarray, "frame angle"]) -> Float[np.ndarray, "frame 3 3"]:
    """Rotations about fixed axes in sequence: `xyz` turns about x first, so its matrix is $R_z R_y R_x$."""
    out = np.broadcast_to(np.eye(3), (len(angles_deg), 3, 3))
    for axis, angles in zip(axes, angles_deg.T, strict=True):
        out = _turn("xyz".index(axis), np.radians(angles)) @ out
    return out


def _turn(axis: int, angles: Float[np.ndarray, " frame"]) -> Float[np.ndarray, "frame 3 3"]:
    """Right-handed rotations about one axis."""
    i, j = (axis + 1) % 3, (axis + 2) % 3
    out = np.zeros((len(angles), 3, 3))
    out[:, axis, axis] = 1.0
    out[:, i, i] = out[:, j, j] = np.cos(angles)
    out[:, j, i] = np.sin(angles)
    out[:, i, j] = -out[:, j, i]
    return out


def longest_path(parents: Sequence[int], offsets: Float[np.ndarray, "joint 3"]) -> float:
    """The longest path along the bones from one end of the skeleton to another; for a person from toe to fingertips."""
    lengths = np.linalg.norm(offsets, axis=-1)
    below = np.zeros(len(parents))
    longest = 0.0
    # Children come before parents, so the paths below a joint are known when it is reached.
    for j in range(len(parents) - 1, -1, -1):
        longest = max(longest, below[j])
        if parents[j] >= 0:
            way = lengths[j] + below[j]
            longest = max(longest, below[parents[j]] + way)
            below[parents[j]] = max(below[parents[j]], way)
    return float(longest)
