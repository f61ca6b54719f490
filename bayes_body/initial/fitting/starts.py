r"""The starts of the fit of a first pose: many orientations of the root, each shifted to the markers or keypoints.

Given the angles, every point of a body is affine in the shifts s: $p_k = a_k + J_k s$. The conditions on the points are linear too: $p_k = m_k$ for a
marker, and $(R_x - x_k R_z)\,p_k + t_x - x_k t_z = 0$, likewise for y, for a keypoint seen at $(x_k, y_k)$ at depth 1. Reweighted least squares
solves them for s, with one camera or with many. With one camera, the body's size determines its distance.

The orientations lie on a grid with a step of thirty degrees for each angle of the root. The best upright orientation of every heading is used,
followed by the best of all others, with random limbs.
"""

import itertools
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from bayes_body.base.config import FAST_COMPILE
from bayes_body.base.geometry import transforms
from bayes_body.base.geometry.camera import Camera, to_camera
from bayes_body.base.geometry.namespaces import device_array
from bayes_body.base.shapes import Key, Pose
from bayes_body.initial.fitting.misfit import Places, Problem, distances, places_of, potential
from bayes_body.model.body.kinematics import forward_kinematics
from bayes_body.model.body.skeleton import Skeleton
from bayes_body.model.body.solids import Body

STEP = np.pi / 6
HEADINGS = 12
# Upright: less than about 25 degrees off.
UPRIGHT = 0.9
MOST = 2048
ROUNDS = 10
# The slope of a pose by its parameters (`shares.py`) vanishes at a limit: starts stay away from it by this fraction of the range.
INSIDE = 0.03
# Width of the misfit when starts are compared.
WIDE = 8.0


class Candidates(NamedTuple):
    """Poses to start from, shifted to the markers or keypoints; their misfit at the width WIDE, whether they are upright, and their heading."""

    poses: Float[Array, "candidate dof"]
    scores: Float[Array, " candidate"]
    upright: Bool[Array, " candidate"]
    heading: Int[Array, " candidate"]


def candidates(problem: Problem, up: int, key: Key) -> Candidates:
    """Return every orientation of the root on a grid twice: with the other angles at the prior's mean, and with random angles within limits.

    Args:
        problem: the fit.
        up: index of the world's axis that points up.
        key: random key for the limbs.
    """
    return _candidates(problem, orientations(problem.body), up, key)


@partial(jax.jit, static_argnames="up", compiler_options=FAST_COMPILE)
def _candidates(problem: Problem, grid: Float[Array, "orientation angle"], up: int, key: Key) -> Candidates:
    skeleton = problem.body.skeleton
    mean_poses = jnp.broadcast_to(problem.prior.mean, (grid.shape[0], problem.prior.mean.shape[0]))
    poses = jnp.concatenate([mean_poses, random_poses(skeleton, key, mean_poses)])
    poses = inside(skeleton, poses.at[:, jnp.array(_root_angles(problem.body), int)].set(jnp.concatenate([grid, grid])))

    def candidate(pose: Pose) -> Candidates:
        moved, places = _moved(problem, pose)
        z = jnp.zeros(problem.scaling.groups.shape[1], pose.dtype)
        score = potential(problem, places, distances(problem, places), moved, z, WIDE)
        upright, heading = _stance(problem.body, pose, up)
        return Candidates(inside(skeleton, moved[None])[0], score, upright, heading)

    return jax.vmap(candidate)(poses)


def choose(proposals: Candidates, count: int) -> Int[np.ndarray, " start"]:
    """Return the indices of the candidates to start from: the best upright one of each heading, then the best of all."""
    order = np.argsort(np.asarray(proposals.scores))
    upright, heading = np.asarray(proposals.upright), np.asarray(proposals.heading)
    first: dict[int, int] = {}
    for i in order[upright[order]]:
        first.setdefault(int(heading[i]), int(i))
    stratified = list(first.values())[:count]
    unstratified = [int(i) for i in order if int(i) not in set(stratified)]
    return np.array((stratified + unstratified)[:count])


def random_poses(skeleton: Skeleton, key: Key, poses: Float[Array, "start dof"]) -> Float[Array, "start dof"]:
    """Return the poses with every limited angle drawn again, uniformly between its limits."""
    low, high = skeleton.low, skeleton.high
    drawn = jnp.isfinite(low) & jnp.isfinite(high) & jnp.array(skeleton.topology.angular)
    u = jax.random.uniform(key, poses.shape, poses.dtype)
    return jnp.where(drawn, jnp.where(drawn, low, 0.0) + u * jnp.where(drawn, high - low, 0.0), poses)


def inside(skeleton: Skeleton, poses: Float[Array, "start dof"]) -> Float[Array, "start dof"]:
    """Return the poses, moved a little away from their limits."""
    bounded = jnp.isfinite(skeleton.low) & jnp.isfinite(skeleton.high)
    margin = INSIDE * jnp.where(bounded, skeleton.high - skeleton.low, 0.0)
    return jnp.clip(poses, skeleton.low + margin, skeleton.high - margin)


def _root_angles(body: Body) -> list[int]:
    return [motion.dof for motion in body.skeleton.topology.motions[0] if not motion.is_shift]


def orientations(body: Body) -> Float[Array, "candidate angle"]:
    """Return every combination of the root's angles on a grid through 0; an angle without limits covers a full turn."""
    axes = []
    for k in _root_angles(body):
        low, high = (float(np.asarray(limit)[k]) for limit in (body.skeleton.low, body.skeleton.high))
        low, high = (low, high) if np.isfinite(low) and np.isfinite(high) else (-np.pi + 0.5 * STEP, np.pi + 0.5 * STEP)
        axes.append(STEP * np.arange(np.ceil(low / STEP), np.floor(high / STEP) + 1))
    grid = np.array(list(itertools.product(*axes))).reshape(-1, len(axes))
    return device_array(grid[:: int(np.ceil(len(grid) / MOST))], body.lengths.dtype)


def _stance(body: Body, pose: Pose, up: int) -> tuple[Bool[Array, ""], Int[Array, ""]]:
    root = transforms.pick(forward_kinematics(body.skeleton, pose), 0)
    a, b = root.x[(up + 1) % 3], root.x[(up + 2) % 3]
    return root.z[up] > UPRIGHT, jnp.round(jnp.arctan2(b, a) / (2 * jnp.pi) * HEADINGS).astype(int) % HEADINGS


def _moved(problem: Problem, pose: Pose) -> tuple[Pose, Places]:
    """Return the pose with the shifts that fit best, and the positions of its points."""
    topology, dtype = problem.body.skeleton.topology, pose.dtype
    shifts = jnp.array([k for k, angular in enumerate(topology.angular) if not angular], int)
    settings = jnp.concatenate([jnp.zeros((1, shifts.size), dtype), jnp.eye(shifts.size, dtype=dtype)])
    no_scaling = jnp.zeros(problem.scaling.groups.shape[1], dtype)
    a, *moved = jax.vmap(lambda s: places_of(problem, pose.at[shifts].set(s), no_scaling))(settings)
    if not moved:
        return pose, a
    J = jnp.stack(moved, axis=-1) - a[:, :, None]
    rows, sides, weights = _equations(problem, a, J)
    s = jnp.zeros(shifts.size, dtype)
    for step in range(ROUNDS):
        # Metres. The scale is large at first, so that the first solution uses all points.
        missed, scale = jnp.sum((rows @ s + sides) ** 2, axis=-1), 2.0 * 0.7**step
        w = weights / (1 + missed / scale**2)
        A = jnp.einsum("e,eis,eit->st", w, rows, rows)
        # A very small ridge: a direction that the data do not determine stays 0.
        s = -jnp.linalg.solve(A + 1e-4 * jnp.eye(s.size, dtype=dtype), jnp.einsum("e,eis,ei->s", w, rows, sides))
    return pose.at[shifts].set(s), a + J @ s


def _equations(
    problem: Problem, a: Float[Array, "point 3"], J: Float[Array, "point 3 shift"]
) -> tuple[Float[Array, "equation 3 shift"], Float[Array, "equation 3"], Float[Array, " equation"]]:
    """Return the equations' rows, sides and weights. `rows s + sides` (metres) is 0 if a point lies where it was measured.

    Keypoints have two rows and an empty third.
    """
    measurements = problem.measurements

    def of_camera(camera: Camera, rays: Float[Array, "point 2"]) -> tuple[Array, Array]:
        p = to_camera(camera, a) + camera.translation
        turned = jnp.moveaxis(to_camera(camera, jnp.moveaxis(J, 1, 2)), 2, 1)
        rows = turned[:, :2] - rays[:, :, None] * turned[:, 2:]
        sides = p[:, :2] - rays * p[:, 2:]
        return jnp.pad(rows, ((0, 0), (0, 1), (0, 0))), jnp.pad(sides, ((0, 0), (0, 1)))

    rows, sides = jax.vmap(of_camera)(problem.rig, measurements.rays)
    return (
        jnp.concatenate([J, rows.reshape(-1, *rows.shape[2:])]),
        jnp.concatenate([a - measurements.markers, sides.reshape(-1, 3)]),
        jnp.concatenate([measurements.marker_weights, measurements.pixel_weights.ravel()]),
    )
