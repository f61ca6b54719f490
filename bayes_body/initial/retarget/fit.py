r"""Fit of a motion: the angles of all frames together, and the lengths that they share, in unconstrained coordinates.

$$U = \sum_t \Bigl[\sum_i \tfrac{\nu + 3}{2} \log\bigl(1 + \tfrac{r_{ti}^2}{\nu \sigma_i^2}\bigr)
    + \tfrac12 \sum_k \bigl(\tfrac{s_{tk} - m_k}{\tau_k}\bigr)^2\Bigr]
    + \tfrac12 \sum_{tk} \Bigl(\frac{s_{t+1,k} - 2 s_{tk} + s_{t-1,k}}{\alpha_k\,\Delta t^2}\Bigr)^2 + \tfrac12 \|z\|^2$$

The first sums are the misfit of a first pose to markers (`bayes_body.initial.fitting.misfit`). The term with second differences keeps dofs that the
landmarks do not determine from jumping between equally good solutions. The lengths depend on z as in `bayes_body.initial.fitting.points`.

The misfit of a single frame has many minima. The most complete frame is therefore searched like a first pose. Each other frame is then fitted by
Gauss-Newton from the solution of its neighbour, and at last all frames together by Adam.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from bayes_body.base.config import FAST_COMPILE
from bayes_body.base.shapes import Index, Pose, Scalar
from bayes_body.initial.fitting.fit import fit as search
from bayes_body.initial.fitting.fit import minimise
from bayes_body.initial.fitting.misfit import NU, Problem
from bayes_body.initial.fitting.points import scaled
from bayes_body.initial.fitting.shares import parameters_of, pose_of
from bayes_body.initial.retarget.problem import landmarks_of_frame
from bayes_body.model.body.kinematics import marker_positions
from bayes_body.model.body.solids import Body

# Gauss-Newton steps of the first frame and of each other one from its neighbour's pose, their damping, and their largest change of an unconstrained
# coordinate.
FIRST_STEPS, FOLLOW_STEPS, DAMPING, LARGEST_STEP = 60, 6, 0.1, 0.5
# Adam's steps and rate, in unconstrained coordinates, for all frames together.
STEPS, RATE = 600, 0.06
# Typical speeds (rad/s for angles, m/s for shifts) and accelerations (rad/s^2, m/s^2) of a person who moves.
SPEEDS, ACCELERATIONS = (10.0, 3.0), (100.0, 20.0)
UP = 2
# The number of frames is padded to a multiple of this, so that recordings of similar length share a compiled program.
BLOCK = 60

type Frames = Float[Array, "frame marker 3"]


class Fitted(NamedTuple):
    """The angles in every frame, and the lengths' parameters."""

    poses: Float[Array, "frame dof"]
    z: Float[Array, " group"]


class Motion(NamedTuple):
    """Landmarks, metres, 0 where they are unknown; a mask, 1 for those that are known; and the time between frames, s."""

    places: Frames
    mask: Float[Array, "frame marker"]
    step_s: Scalar


def fit_motion(problem: Problem, places: Float[np.ndarray, "frame marker 3"], fps: float) -> Fitted:
    """Return the poses with the smallest misfit to the landmarks (metres, NaN where unknown) at `fps` frames a second.

    Raises:
        InputError: no start led to finite numbers.
    """
    dtype, frames = problem.body.lengths.dtype, len(places)
    places = filled(places, np.nan)
    is_measured = np.isfinite(places).all(axis=-1)
    motion = Motion(jnp.asarray(np.where(is_measured[..., None], places, 0.0), dtype), jnp.asarray(is_measured, dtype), jnp.asarray(1 / fps, dtype))
    first = int(is_measured.sum(axis=1).argmax())
    best, _ = search(problem._replace(measurements=landmarks_of_frame(places[first], dtype)), UP)
    started = follow(problem, motion, best.pose, best.z, jnp.asarray(_order(first, len(places))), jnp.asarray(first))
    solution = fit_together(problem, motion, started, best.z)
    return Fitted(solution.poses[:frames], solution.z)


def filled(frames: Float[np.ndarray, "frame *rest"], value: float) -> Float[np.ndarray, "more *rest"]:
    """Return the frames, padded with frames of that value to a multiple of `BLOCK`."""
    return np.concatenate([frames, np.full((-len(frames) % BLOCK, *frames.shape[1:]), value)])


def _order(first: int, frames: int) -> Int[np.ndarray, " frame"]:
    """Return the order of the frames: from `first` to the end, then from `first` back to the beginning."""
    return np.concatenate([np.arange(first, frames), np.arange(first)[::-1]])


@jax.jit(compiler_options=FAST_COMPILE)
def follow(problem: Problem, motion: Motion, pose: Pose, z: Float[Array, " group"], order: Int[Array, " frame"], first: Index) -> Array:
    """Return the unconstrained angles of every frame. Each frame is fitted from its neighbour's solution; the lengths are fixed."""
    start, body = parameters_of(problem.body.skeleton, pose), scaled(problem.body, problem.scaling, z)
    # The search may stop where the landmarks leave a direction open, with a pelvis that leans. The first frame has no neighbour that holds it there.
    start = _gauss_newton(problem, body, start, motion.places[first], motion.mask[first], jnp.inf * motion.step_s, FIRST_STEPS)

    def fit_frame(previous_x: Pose, frame: Index) -> tuple[Pose, Pose]:
        # The frame before `first` starts from the first pose, not from the solution of the last frame.
        previous_x = jnp.where(frame == first - 1, start, previous_x)
        x = _gauss_newton(problem, body, previous_x, motion.places[frame], motion.mask[frame], motion.step_s, FOLLOW_STEPS)
        return x, x

    _, solutions = jax.lax.scan(fit_frame, start, order)
    return jnp.zeros_like(solutions).at[order].set(solutions)


def _gauss_newton(
    problem: Problem, body: Body, start: Pose, markers: Float[Array, "marker 3"], mask: Float[Array, " marker"], step_s: Scalar, steps: int
) -> Pose:
    r"""Return the unconstrained angles of one frame, near those of its neighbour, which is `step_s` away.

    The robust misfit's Gauss-Newton weights are $w_i = (\nu + 3) / (\nu \sigma_i^2 + r_i^2)$. The landmarks leave some directions almost open,
    such as the pelvis's tilt. Adam, whose steps do not depend on the size of the slope, drifts along them from frame to frame; a step of Gauss-Newton
    goes to where prior and neighbour have them.
    """
    usual, neighbour = _by_unit(problem, SPEEDS) * step_s, pose_of(problem.body.skeleton, start)

    def residuals(x: Pose) -> tuple[Array, Array, Array]:
        pose = pose_of(problem.body.skeleton, x)
        return (
            marker_positions(body.skeleton, body.markers, pose) - markers,
            (pose - problem.prior.mean) / problem.prior.sd,
            (pose - neighbour) / usual,
        )

    def step(x: Pose, _: None) -> tuple[Pose, None]:
        missed, expected, moved = residuals(x)
        slopes = jax.jacfwd(residuals)(x)
        weights = mask * (NU + 3) / (NU * problem.tolerance**2 + jnp.sum(missed**2, axis=1))
        terms = ((missed.ravel(), slopes[0].reshape(-1, len(x)), jnp.repeat(weights, 3)), (expected, slopes[1], 1.0), (moved, slopes[2], 1.0))
        normal = sum((slope.T * weight) @ slope for _, slope, weight in terms) + DAMPING * jnp.eye(len(x), dtype=x.dtype)
        gradient = sum((slope.T * weight) @ residual for residual, slope, weight in terms)
        change = jnp.linalg.solve(normal, gradient)
        return x - jnp.clip(change, -LARGEST_STEP, LARGEST_STEP), None

    return jax.lax.scan(step, start, None, steps)[0]


class _Parameters(NamedTuple):
    x: Float[Array, "frame dof"]
    z: Float[Array, " group"]


@jax.jit(compiler_options=FAST_COMPILE)
def fit_together(problem: Problem, motion: Motion, x: Float[Array, "frame dof"], z: Float[Array, " group"]) -> Fitted:
    """Fit all frames and the lengths together, starting from unconstrained angles `x` and length parameters `z`."""
    optimum, _ = minimise(lambda p, _: (jax.grad(_misfit, argnums=2)(problem, motion, p), ()), _Parameters(x, z), RATE, STEPS)
    return Fitted(pose_of(problem.body.skeleton, optimum.x), optimum.z)


def _misfit(problem: Problem, motion: Motion, parameters: _Parameters) -> Scalar:
    poses, body = pose_of(problem.body.skeleton, parameters.x), scaled(problem.body, problem.scaling, parameters.z)
    misfits = jax.vmap(_misfit_of_frame, (None, None, 0, 0, 0))(problem, body, poses, motion.places, motion.mask)
    return jnp.sum(misfits) + 0.5 * jnp.sum(parameters.z**2) + _jerkiness(problem, poses, motion.step_s)


def _misfit_of_frame(problem: Problem, body: Body, pose: Pose, markers: Float[Array, "marker 3"], weights: Float[Array, " marker"]) -> Scalar:
    missed = jnp.sum((marker_positions(body.skeleton, body.markers, pose) - markers) ** 2, axis=1)
    robust = 0.5 * (NU + 3) * jnp.log1p(missed / (NU * problem.tolerance**2))
    return jnp.sum(weights * robust) + 0.5 * jnp.sum(((pose - problem.prior.mean) / problem.prior.sd) ** 2)


def _by_unit(problem: Problem, values: tuple[float, float]) -> Pose:
    """Return the first value for each angle, the second for each shift."""
    return jnp.where(jnp.array(problem.body.skeleton.topology.angular), *(jnp.asarray(value, problem.body.lengths.dtype) for value in values))


def _jerkiness(problem: Problem, poses: Float[Array, "frame dof"], step_s: Scalar) -> Scalar:
    usual = _by_unit(problem, ACCELERATIONS) * step_s**2
    bends = poses[2:] - 2 * poses[1:-1] + poses[:-2]
    return 0.5 * jnp.sum((bends / usual) ** 2)
