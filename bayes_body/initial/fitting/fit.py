r"""Fit of the first pose: many starts, optimised in parallel by Adam in unconstrained coordinates, with a misfit whose width shrinks.

One compiled program runs in rounds. The first round starts from every heading and the best of a random population. Several rounds follow that start
from the best results with the angles of some limbs drawn again. This frees a limb that went round the wrong way, and tries the other of two depths
that one camera cannot distinguish. The last round starts from the best result and takes small steps.

The fits of first poses, motions and outlines use Adam (Kingma & Ba 2015) with a decaying learning rate (docs/decisions/18_least_squares.md). Step k
of n has progress $p = k / (n - 1)$ and learning rate $\tfrac12 r (1 + \cos \pi p)$, which ends at 0.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple, cast

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Float, Int

from bayes_body.base.config import FAST_COMPILE
from bayes_body.base.errors import InputError
from bayes_body.base.geometry.namespaces import device_array
from bayes_body.base.shapes import Key, Pose, Scalar
from bayes_body.initial.fitting.misfit import Explained, Problem, explain
from bayes_body.initial.fitting.shares import parameters_of, pose_of
from bayes_body.initial.fitting.starts import candidates, choose, inside, random_poses


def minimise[Parameters, Info](
    slope: Callable[[Parameters, Scalar], tuple[Parameters, Info]], start: Parameters, rate: float | Scalar, steps: int
) -> tuple[Parameters, Info]:
    """Return the parameters after all steps, and the extra output of the last call of `slope`.

    The last step has rate 0, so that output belongs to the returned parameters.

    Args:
        slope: maps the parameters and the progress (0 to 1) to the gradient and any extra output.
        start: any pytree of arrays of one dtype.
        rate: learning rate of the first step, in the parameters' unit.
        steps: number of steps; each calls `slope` once.
    """
    adam, at_start = optax.scale_by_adam(b1=0.9, b2=0.99), cast(Any, start)
    dtype = jax.tree.leaves(start)[0].dtype

    def step(carry: tuple[Any, Any, Any], progress: Scalar) -> tuple[tuple[Any, Any, Any], None]:
        parameters, state, _ = carry
        gradient, info = slope(parameters, progress)
        direction, state = adam.update(cast(Any, gradient), state)
        pace = -0.5 * rate * (1 + jnp.cos(jnp.pi * progress))
        return (optax.apply_updates(parameters, optax.tree.scale(pace, direction)), state, info), None

    _, shape = jax.eval_shape(slope, start, jnp.ones((), dtype))
    empty_info = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), shape)
    (parameters, _, info), _ = jax.lax.scan(step, (at_start, adam.init(at_start), empty_info), jnp.linspace(0, 1, steps, dtype=dtype))
    return parameters, info


# Number of starts in a round, of steps from each start, and of rounds in which limbs are redrawn. With these, 96 of 100 poses that were drawn
# uniformly within the limits of `deutscher_31` are recovered from their markers to less than 10 mm at the worst marker.
STARTS = 48
STEPS = 300
THROWS = 3
# Number of different results of a round from which the next round starts, the distance at which two results count as different, and the probability
# that a joint is redrawn.
KEPT = 8
APART_M = 0.1
THROWN = 0.3
# Adam's initial rate in the search rounds and in the last round, in unconstrained coordinates; and the initial width of the misfit in the first
# search round and in those with redrawn limbs.
SEARCH, SEARCH_WIDTH, THROW_WIDTH, REFINE = 0.1, 8.0, 4.0, 0.05
# If the last round lowers the misfit by more than this, the search had not converged.
SETTLED = 0.5
# Strength of the downward pull on the points of a resting body, per metre. It is much stronger than the pull of the angles towards 0.
WEIGHT = 30.0


class Fit(NamedTuple):
    """The best pose with its misfit, points and distances, and the decrease of the misfit in the last round."""

    best: Explained
    gain: float


class Descent(NamedTuple):
    """The results of all starts; each leaf has a leading axis of starts. The misfit is NaN for a start that diverged."""

    parameters: Float[Array, "start parameter"]
    explained: Explained

    @property
    def order(self) -> Int[np.ndarray, " start"]:
        """The starts from the best to the worst; diverged ones are last."""
        return np.argsort(np.asarray(self.explained.misfit))


def fit(problem: Problem, up: int) -> Fit:
    """Return the pose with the smallest misfit found. The result is always the same for the same problem.

    Raises:
        InputError: no start led to finite numbers.
    """
    keys = jax.random.split(jax.random.key(0), 2 + THROWS)
    start = candidates(problem, up, keys[0])
    # Rows are taken on the host: on the device, each such operation would be a program of its own.
    descent = descend(problem, unbounded(problem, np.asarray(start.poses)[choose(start, STARTS)]), SEARCH, SEARCH_WIDTH)
    for key in keys[2:]:
        descent = descend(problem, _thrown(problem, key, np.asarray(descent.parameters)[_different(descent)]), SEARCH, THROW_WIDTH)
    best_start = descent.order[0]
    last = descend(problem, _jittered_starts(keys[1], np.asarray(descent.parameters)[best_start]), REFINE, 1.0)
    best: Explained = jax.tree.map(lambda leaf: device_array(np.asarray(leaf)[last.order[0]], leaf.dtype), last.explained)
    if not np.isfinite(best.misfit):
        found_no = "session.toml: initial: the fit did not converge; expected finite numbers"
        raise InputError(f"{found_no}; check the calibration, or give the pose in angles.")
    return Fit(best, float(np.asarray(descent.explained.misfit)[best_start] - best.misfit))


def fit_resting_pose(problem: Problem) -> Pose:
    """Return the body's resting pose: upright, with hanging limbs. The optimisation starts from the prior's mean, by the same program as `fit`."""
    no_measurements = jax.tree.map(np.zeros_like, problem.measurements)
    poses = np.tile(problem.prior.mean, (STARTS, 1))
    heavy = problem.prior._replace(weights=np.asarray(WEIGHT * np.asarray(problem.points.hanging), poses.dtype))
    hanging = descend(problem._replace(measurements=no_measurements, prior=heavy), unbounded(problem, poses), SEARCH, 1.0)
    return device_array(np.asarray(hanging.explained.pose)[0], poses.dtype)


def descend(
    problem: Problem,
    starts: Float[Array | np.ndarray, "start parameter"],
    rate: float | Scalar,
    width: float | Scalar,
    markers: Float[Array | np.ndarray, "start point 3"] | None = None,
) -> Descent:
    """Run Adam from every start. The misfit's width falls from `width` to 1 in the first half of the steps.

    Args:
        problem: the problem.
        starts: unconstrained parameters.
        rate: learning rate of the first step.
        width: factor of all standard deviations at the beginning.
        markers: positions in the world in place of the problem's markers, for each start; metres.
    """
    if markers is None:
        markers = np.broadcast_to(problem.measurements.markers, (len(starts), *problem.measurements.markers.shape))
    return _descend(problem, starts, rate, width, markers)


# Not `FAST_COMPILE`: this runs in six rounds or more, and one second of further compilation makes them seven times as fast.
@jax.jit
def _descend(
    problem: Problem, starts: Float[Array, "start parameter"], rate: Scalar, width: Scalar, markers: Float[Array, "start point 3"]
) -> Descent:
    def slope(parameters: Float[Array, "start parameter"], progress: Scalar) -> tuple[Float[Array, "start parameter"], Explained]:
        annealed_width = jnp.maximum(width ** (1 - 2 * progress), 1.0)
        return jax.vmap(lambda start, places: jax.grad(misfit, has_aux=True)(start, places, annealed_width))(parameters, markers)

    def misfit(parameters: Float[Array, " parameter"], places: Float[Array, "point 3"], annealed_width: Scalar) -> tuple[Scalar, Explained]:
        return explain(problem._replace(measurements=problem.measurements._replace(markers=places)), parameters, annealed_width)

    return Descent(*minimise(slope, starts, rate, STEPS))


def fit_draws(
    problem: Problem, starts: Float[Array | np.ndarray, "draw parameter"], markers: Float[np.ndarray, "draw point 3"]
) -> Float[np.ndarray, "draw dof"]:
    """Return the pose that fits each draw's own markers, from a start nearby. It is computed by the same program as `fit`.

    Args:
        problem: the problem; its markers are replaced by each draw's, with the same weights.
        starts: unconstrained parameters to start from.
        markers: positions in the world, metres.

    Returns:
        Radians and metres.
    """
    starts, poses = np.asarray(starts), list[np.ndarray]()
    markers = np.asarray(markers, starts.dtype)
    for first in range(0, len(starts), STARTS):
        # Always as many starts as `fit` has, so that nothing is compiled again.
        rows = np.minimum(np.arange(first, first + STARTS), len(starts) - 1)
        poses.append(np.asarray(descend(problem, starts[rows], REFINE, 1.0, markers[rows]).explained.pose))
    return np.concatenate(poses)[: len(starts)]


def _different(descent: Descent) -> Int[np.ndarray, " kept"]:
    """Return the best starts, without those that ended at the same place as a better one."""
    places, start_indices = np.asarray(descent.explained.places), list[int]()
    for i in descent.order:
        if all(np.linalg.norm(places[i] - places[k], axis=-1).mean() > APART_M for k in start_indices):
            start_indices.append(int(i))
    # Always the same number, so that nothing is compiled again.
    return np.resize(start_indices[:KEPT], KEPT)


@partial(jax.jit, compiler_options=FAST_COMPILE)
def _jittered_starts(key: Key, parameters: Float[Array, " parameter"]) -> Float[Array, "start parameter"]:
    """Return starts around the best parameters, which are the first of them."""
    jitter = 0.01 * jax.random.normal(key, (STARTS, *parameters.shape), parameters.dtype)
    return parameters + jitter.at[0].set(0)


@jax.jit
def unbounded(problem: Problem, poses: Float[Array, "start dof"]) -> Float[Array, "start parameter"]:
    """Return the unconstrained parameters of poses, with the body's own lengths."""
    skeleton = problem.body.skeleton
    z = jnp.zeros((poses.shape[0], problem.scaling.groups.shape[1]), poses.dtype)
    return jnp.concatenate([parameters_of(skeleton, inside(skeleton, poses)), z], axis=1)


@partial(jax.jit, compiler_options=FAST_COMPILE)
def _thrown(problem: Problem, key: Key, best: Float[Array, "kept parameter"]) -> Float[Array, "start parameter"]:
    """Return STARTS starts: the best ones, and copies of them in which the angles of some joints, never the root's, are drawn again."""
    topology, count = problem.body.skeleton.topology, len(problem.body.dof_names)
    parameters = jnp.tile(best, (-(-STARTS // best.shape[0]), 1))[:STARTS]
    skeleton = problem.body.skeleton
    poses = pose_of(skeleton, parameters[:, :count])
    joints_key, angles_key = jax.random.split(key)
    joints = jax.random.uniform(joints_key, (STARTS, len(topology.joint_names))) < THROWN
    joints = joints.at[:, 0].set(False).at[: best.shape[0]].set(False)
    owner = {motion.dof: j for j, motions in enumerate(topology.motions) for motion in motions}
    redrawn = joints[:, jnp.array([owner[k] for k in range(count)])]
    thrown = unbounded(problem, random_poses(skeleton, angles_key, poses))[:, :count]
    return parameters.at[:, :count].set(jnp.where(redrawn, thrown, parameters[:, :count]))
