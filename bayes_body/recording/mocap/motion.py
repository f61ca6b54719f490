"""A captured motion, whatever file it came from: metres, z up, world frame."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float


@dataclass(frozen=True, eq=False)
class Motion:
    """Joints of a skeleton, or loose markers, over time.

    Attributes:
        name: of the file, for sentences.
        fps: frames a second.
        joints: their names, as the file has them.
        parents: for each joint the index of the one that it hangs on, parents before children; -1 for a root, and for loose markers.
        positions_m: (frame, joint, 3), metres, z up; NaN where unknown.
        rotations: (frame, joint, 3, 3), `T_world_joint`'s rotation; None where the file holds points only.
    """

    name: str
    fps: float
    joints: tuple[str, ...]
    parents: tuple[int, ...]
    positions_m: Float[np.ndarray, "frame joint 3"]
    rotations: Float[np.ndarray, "frame joint 3 3"] | None = None
