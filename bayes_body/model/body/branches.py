r"""Different angles for the same rotations or the same markers, and the choice among them.

A rotation determines its angles up to full turns, and up to the second solution of a joint with three angles. The second solution is $(s_1 + \pi, \pi
- s_2, s_3 + \pi)$ if all three axes differ, and $(s_1 + \pi, -s_2, s_3 + \pi)$ if the first axis is also the third (Diebel 2006, Representing
attitude, 5.6). The signs of the dofs change it by full turns only.

Markers leave some angles open: a pelvis with a marker at each hip can pitch freely if hips and thorax turn back. Of all poses that place the markers
alike, the one nearest to rest makes the angles of different people and motions comparable. The distance from rest is that of angles divided by
$\sigma_k \propto \mathrm{range}_k^2$: joints with a small range, those of the spine, move least.

$$\min_s\ \sum_i \frac{\|m_i(s) - m_i\|^2}{\epsilon^2} + \sum_k \Bigl(\frac{s_k - r_k}{\sigma_k}\Bigr)^2$$

Gauss-Newton steps start from the given pose. The second solutions of joints and full turns are treated separately.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from bayes_body.base.shapes import Pose
from bayes_body.model.body.kinematics import marker_positions
from bayes_body.model.body.skeleton import Topology
from bayes_body.model.body.solids import Body

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
            is_flipped = jnp.sum(_differences(flipped_angles, reference[dofs]) ** 2) < jnp.sum(_differences(angles, reference[dofs]) ** 2)
            sign = sign.at[dofs].set(jnp.where(is_flipped, flip[0], 1.0))
            offset = offset.at[dofs].set(jnp.where(is_flipped, flip[1], 0.0))
    turns = TURN * jnp.round((reference - (sign * pose + offset)) / TURN)
    return Branch(sign, offset + jnp.where(np.array(topology.angular), turns, 0.0))


def _differences(angles: Array, reference: Array) -> Array:
    """Return the differences, at most half a turn."""
    differences = angles - reference
    return differences - TURN * jnp.round(differences / TURN)


# Metres. Markers move by less than this, except where an angle hardly changes them.
EPSILON_M = 1e-3
ITERATIONS = 8


def settled(body: Body, pose: Pose) -> Pose:
    """Return the pose nearest to rest that places the markers as this one does, radians and metres. The root's dofs have no rest."""
    low, high = body.skeleton.low, body.skeleton.high
    rest_pose = jnp.clip(jnp.zeros_like(low), low, high)
    limited = jnp.isfinite(low) & jnp.isfinite(high)
    free = np.zeros(len(body.dof_names), bool)
    free[[motion.dof for motion in body.skeleton.topology.motions[0]]] = True
    weights = jnp.where(limited & ~free, (TURN / jnp.where(limited, high - low, TURN)) ** 4, 0.0)
    wanted = _places(body, pose)

    def step(iterate: Pose, _: None) -> tuple[Pose, None]:
        J = jax.jacfwd(lambda s: _places(body, s))(iterate)
        # The small diagonal is for dofs that neither markers nor rest determine.
        curvature = J.T @ J + jnp.diag(weights + 1e-3)
        moved = jnp.linalg.solve(curvature, J.T @ (wanted - _places(body, iterate)) + weights * (rest_pose - iterate))
        return jnp.clip(iterate + moved, low, high), None

    return jax.lax.scan(step, pose, None, length=ITERATIONS)[0]


def _places(body: Body, pose: Pose) -> Float[Array, " coordinate"]:
    return marker_positions(body.skeleton, body.markers, pose).ravel() / EPSILON_M
