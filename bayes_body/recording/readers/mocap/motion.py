"""A captured motion, whatever the file format: metres, z up, world frame."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float


@dataclass(frozen=True, eq=False)
class Motion:
    """Joints of a skeleton, or loose markers, over time.

    Attributes:
        name: the file's name, for messages.
        fps: frames per second.
        joints: the names in the file.
        parents: index of each joint's parent, parents before children; -1 for a root and for loose markers.
        positions_m: (frame, joint, 3), metres, z up; NaN where unknown.
        rotations: (frame, joint, 3, 3), `T_world_joint`'s rotation; None if the file holds points only.
    """

    name: str
    fps: float
    joints: tuple[str, ...]
    parents: tuple[int, ...]
    positions_m: Float[np.ndarray, "frame joint 3"]
    rotations: Float[np.ndarray, "frame joint 3 3"] | None = None
