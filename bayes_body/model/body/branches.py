r"""Different angles for the same rotations: full turns, and the second solution of a joint with three angles.

The second solution is $(s_1 + \pi, \pi - s_2, s_3 + \pi)$ if all three axes differ, and $(s_1 + \pi, -s_2, s_3 + \pi)$ if the first axis is also the
third (Diebel 2006, Representing attitude, 5.6). The signs of the dofs change it by full turns only.
"""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from bayes_body.base.shapes import Pose
from bayes_body.model.body.skeleton import Topology

TURN = 2 * np.pi


class Branch(NamedTuple):
    """Other angles for the same rotations, `sign * angle + offset`."""

    sign: Float[Array, " dof"]
    offset: Float[Array, " dof"]

    def __call__(self, pose: Float[Array, "*frame dof"]) -> Float[Array, "*frame dof"]:
        """Return the same rotations as the angles of this branch; shifts do not change."""
        return self.sign * pose + self.offset


def nearest_branch(topology: Topology, pose: Pose, reference: Pose) -> Branch:
    """Return the branch in which the pose is nearest to the reference: one solution for each joint, then full turns. Limits are not regarded."""
    sign, offset = jnp.ones_like(pose), jnp.zeros_like(pose)
    for motions in topology.motions:
        if len(motions) == 3 and not any(motion.is_shift for motion in motions):
            dofs = np.array([motion.dof for motion in motions])
            flip = jnp.array([1.0, -1.0, 1.0]), jnp.array([np.pi, 0.0 if motions[0].axis == motions[2].axis else np.pi, np.pi])
            angles = pose[dofs]
            flipped_angles = flip[0] * angles + flip[1]
            far = jnp.sum(_apart(flipped_angles, reference[dofs]) ** 2) < jnp.sum(_apart(angles, reference[dofs]) ** 2)
            sign = sign.at[dofs].set(jnp.where(far, flip[0], 1.0))
            offset = offset.at[dofs].set(jnp.where(far, flip[1], 0.0))
    turns = TURN * jnp.round((reference - (sign * pose + offset)) / TURN)
    return Branch(sign, offset + jnp.where(np.array(topology.angular), turns, 0.0))


def _apart(angles: Array, reference: Array) -> Array:
    """Return the differences, at most half a turn."""
    differences = angles - reference
    return differences - TURN * jnp.round(differences / TURN)
