r"""Of all poses that place the markers alike, the one nearest to rest: it makes the angles of different people and motions comparable.

Markers leave some angles open. A pelvis with a marker at each hip can pitch freely if hips and thorax turn back. Distance from rest is that of angles
over $\sigma_k \propto \mathrm{range}_k^2$: joints with a small range, those of the spine, move least.

$$\min_s\ \sum_i \frac{\|m_i(s) - m_i\|^2}{\epsilon^2} + \sum_k \Bigl(\frac{s_k - r_k}{\sigma_k}\Bigr)^2$$

Gauss-Newton steps start from the given pose. The second solutions of joints and full turns are treated elsewhere (`bayes_body.model.body.branches`).
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from bayes_body.base.shapes import Pose
from bayes_body.model.body.branches import TURN
from bayes_body.model.body.kinematics import marker_positions
from bayes_body.model.body.solids import Body

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
