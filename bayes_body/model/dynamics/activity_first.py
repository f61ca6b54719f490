r"""The state of an activity before the first frame, from a first pose.

The pose's angles may say what no walker does, though its markers are right to some centimetres. Of a person who is placed by hand to 15 mm, the line
of the hips is turned by up to 30 degrees, and thighs and thorax turn back. So position, orientation, features f, residual r and the head's angles h
are those that place the markers m as the pose $s_0$ does, and that the activity expects,

$$\min\ \sum_i \frac{\|m_i - m_i(s_0)\|^2}{\sigma_m^2} + (f - \bar\mu)^\top \bar\Sigma^{-1} (f - \bar\mu) + \sum_k \frac{r_k^2}{\sigma_k^2}
  + \frac{\|h - h_0\|^2}{\sigma_h^2},$$

with the mean and covariance of all hidden states together, by Gauss-Newton steps.
"""

import jax
import jax.flatten_util
import jax.numpy as jnp
from jaxtyping import Array, Float
from numpyro.distributions import LowRankMultivariateNormal

from bayes_body.base.shapes import Pose
from bayes_body.density.factor import State
from bayes_body.model.body.branches import nearest_branch, settled
from bayes_body.model.body.kinematics import marker_positions
from bayes_body.model.body.placement import POSE
from bayes_body.model.body.solids import Body
from bayes_body.model.dynamics.activity_arrays import (
    BEFORE,
    BELIEF,
    FEATURES,
    HEAD,
    ORIENTATION,
    POSITION,
    RESIDUAL,
    ActivityArrays,
    derive_pose,
    log_emissions,
)
from bayes_body.model.dynamics.diffusion import ROOT_DOFS

# Standard deviations of the pose's markers and of the head's angles, metres and radians.
PLACED_SD_M, HEAD_SD = 0.02, 0.2
# Steps of the search, the longest change of a variable in one, and what keeps a step finite where nothing determines a variable.
ITERATIONS, LONGEST_STEP, RIDGE = 15, 0.5, 1e-4


@jax.jit
def begin(arrays: ActivityArrays, body: Body, first: State) -> dict[str, Array]:
    """Return the state of a first pose: its features, what they leave, and the probabilities of the hidden states."""
    first_pose = jnp.asarray(first[POSE], arrays.mean.dtype)
    reference = first_pose.at[arrays.learned].set(arrays.mean)
    pose = settled(body, nearest_branch(body.skeleton.topology, first_pose, reference)(first_pose))
    state = _nearest(arrays, body, pose)
    if RESIDUAL in arrays.sd:
        deviation = arrays.basis @ state[FEATURES] + state[RESIDUAL]
        state[FEATURES] = _likely_features(arrays, deviation)
        state[RESIDUAL] = deviation - arrays.basis @ state[FEATURES]
    state[BEFORE] = state[POSITION]
    state[BELIEF] = jax.nn.softmax(jnp.log(arrays.initial + jnp.finfo(pose.dtype).tiny) + log_emissions(arrays, state[FEATURES]))
    return state | derive_pose(arrays, state)


def _likely_features(arrays: ActivityArrays, deviation: Float[Array, " dof"]) -> Float[Array, " feature"]:
    """Return the features of a first pose: the most probable ones under the state that explains the pose best.

    Its projection may be far from all states. It would be left in the first frame, and the pose with it, because the residual changes slowly.
    """
    spread = jnp.square(_residual_sd(arrays))
    explained = LowRankMultivariateNormal(arrays.locations @ arrays.basis.T, arrays.basis @ arrays.factor, spread).log_prob(deviation)
    best = jnp.argmax(jnp.log(arrays.initial) + explained)
    covariance = arrays.factor[best] @ arrays.factor[best].T
    gain = covariance @ arrays.basis.T @ jnp.linalg.inv(arrays.basis @ covariance @ arrays.basis.T + jnp.diag(spread))
    return arrays.locations[best] + gain @ (deviation - arrays.basis @ arrays.locations[best])


def _residual_sd(arrays: ActivityArrays) -> Float[Array, " dof"]:
    return arrays.sd[RESIDUAL] / jnp.sqrt(1 - jnp.square(arrays.keep))


def _nearest(arrays: ActivityArrays, body: Body, pose: Pose) -> dict[str, Array]:
    """Return the sampled variables that place the markers nearly as a pose does and that the activity expects."""
    covariances = arrays.factor @ jnp.swapaxes(arrays.factor, 1, 2)
    mean = arrays.initial @ arrays.locations
    offsets = arrays.locations - mean
    root = jnp.linalg.cholesky(jnp.einsum("s,sfg->fg", arrays.initial, covariances + offsets[:, :, None] * offsets[:, None, :]))
    start = {FEATURES: mean, POSITION: pose[:3], ORIENTATION: pose[3:ROOT_DOFS]}
    if HEAD in arrays.sd:
        start[HEAD] = pose[arrays.head]
    if RESIDUAL in arrays.sd:
        start[RESIDUAL] = jnp.zeros_like(arrays.mean)
    places = marker_positions(body.skeleton, body.markers, pose)

    def errors(sampled: State) -> Array:
        moved = marker_positions(body.skeleton, body.markers, derive_pose(arrays, sampled)[POSE]) - places
        prior = [jax.scipy.linalg.solve_triangular(root, sampled[FEATURES] - mean, lower=True)]
        if HEAD in sampled:
            prior.append((sampled[HEAD] - pose[arrays.head]) / HEAD_SD)
        if RESIDUAL in sampled:
            prior.append(sampled[RESIDUAL] / _residual_sd(arrays))
        return jnp.concatenate([moved.ravel() / PLACED_SD_M, *prior])

    flat, unflatten = jax.flatten_util.ravel_pytree(start)

    def step(iterate: Array, _: None) -> tuple[Array, None]:
        J = jax.jacfwd(lambda x: errors(unflatten(x)))(iterate)
        change = jnp.linalg.solve(J.T @ J + RIDGE * jnp.eye(len(iterate)), J.T @ errors(unflatten(iterate)))
        return iterate - change * jnp.minimum(1.0, LONGEST_STEP / jnp.max(jnp.abs(change))), None

    return unflatten(jax.lax.scan(step, flat, None, length=ITERATIONS)[0])
