"""Many starts, fitted at once by Adam in unconstrained coordinates, with a misfit that narrows as they go.

One compiled program runs in rounds: from every heading and the best of a random population; several times from the best of these with some limbs
thrown anew, which frees a limb that went round the wrong way and tries the other of two depths that one camera cannot tell apart; and from the best
once more in small steps.
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from bayes_body.config import FAST_COMPILE
from bayes_body.dynamics.limits import BoxTransform
from bayes_body.errors import InputError
from bayes_body.initial.adam import minimise
from bayes_body.initial.misfit import Explained, Problem, explain
from bayes_body.initial.starts import candidates, choose, inside, random_poses
from bayes_body.shapes import Key, Pose, Scalar

# Starts of a round, their steps, and how often limbs are thrown: with these, 96 of 100 poses drawn evenly within the limits of `deutscher_31` come
# back from their markers to less than 10 mm at the worst marker.
STARTS = 48
STEPS = 300
THROWS = 3
# The different results of a round that the next starts from, how far apart makes them different, and how likely a joint is thrown.
KEPT = 8
APART_M = 0.1
THROWN = 0.3
# Adam's rate at first, in unconstrained coordinates, and how much wider the misfit is.
SEARCH, SEARCH_WIDTH, THROW_WIDTH, REFINE = 0.1, 8.0, 4.0, 0.05
# A last round that takes off more than this had not settled before.
SETTLED = 0.5
# How strongly a resting body's points are pulled down, per metre: much more than the angles are drawn to 0.
WEIGHT = 30.0


class Fit(NamedTuple):
    """The best pose with all that is known of it, and how much misfit the last round still took off."""

    best: Explained
    gain: float


class Descent(NamedTuple):
    """Where every start went, its leaves with a leading axis of starts; the misfit of a start that was lost is NaN."""

    parameters: Float[Array, "start parameter"]
    explained: Explained

    @property
    def order(self) -> Int[np.ndarray, " start"]:
        """The starts from the best to the worst, lost ones last."""
        return np.argsort(np.asarray(self.explained.misfit))


def fit(problem: Problem, up: int) -> Fit:
    """The pose of the least misfit that was found; always the same for the same problem.

    Raises:
        InputError: no start led to finite numbers.
    """
    keys = jax.random.split(jax.random.key(0), 2 + THROWS)
    start = candidates(problem, up, keys[0])
    found = descend(problem, _unbounded(problem, start.poses[choose(start, STARTS)]), SEARCH, SEARCH_WIDTH)
    for key in keys[2:]:
        found = descend(problem, _thrown(problem, key, found.parameters[_different(found)]), SEARCH, THROW_WIDTH)
    before = found.order[0]
    jitter = 0.01 * jax.random.normal(keys[1], found.parameters.shape, found.parameters.dtype)
    last = descend(problem, found.parameters[before] + jitter.at[0].set(0), REFINE, 1.0)
    best: Explained = jax.tree.map(lambda leaf: leaf[last.order[0]], last.explained)
    if not jnp.isfinite(best.misfit):
        found_no = "session.toml: initial: the fit did not converge; expected finite numbers"
        raise InputError(f"{found_no}; check the calibration, or give the pose in angles.")
    return Fit(best, float(found.explained.misfit[before] - best.misfit))


def rest(problem: Problem) -> Pose:
    """How the body stands where nothing is known of it: upright, its limbs hanging from where the prior has them, by the same program as `fit`."""
    nothing = jax.tree.map(jnp.zeros_like, problem.measurements)
    poses = jnp.tile(problem.prior.mean, (STARTS, 1))
    heavy = problem.prior._replace(weights=WEIGHT * jnp.asarray(problem.points.hanging, poses.dtype))
    return descend(problem._replace(measurements=nothing, prior=heavy), _unbounded(problem, poses), SEARCH, 1.0).explained.pose[0]


# Not `FAST_COMPILE`: it runs in six rounds or more, which the compiler makes seven times as fast in a second.
@jax.jit
def descend(problem: Problem, starts: Float[Array, "start parameter"], rate: float | Scalar, width: float | Scalar) -> Descent:
    """Adam from every start; the misfit's width falls from `width` to 1 in the first half."""

    def slope(parameters: Float[Array, "start parameter"], progress: Scalar) -> tuple[Float[Array, "start parameter"], Explained]:
        now = jnp.maximum(width ** (1 - 2 * progress), 1.0)
        return jax.vmap(jax.grad(explain, argnums=1, has_aux=True), (None, 0, None))(problem, parameters, now)

    return Descent(*minimise(slope, starts, rate, STEPS))


def _different(found: Descent) -> Int[np.ndarray, " kept"]:
    """The best of the starts, without those that went where a better one is."""
    places, kept = np.asarray(found.explained.places), list[int]()
    for i in found.order:
        if all(np.linalg.norm(places[i] - places[k], axis=-1).mean() > APART_M for k in kept):
            kept.append(int(i))
    # Always as many, so that nothing compiles anew.
    return np.resize(kept[:KEPT], KEPT)


@jax.jit
def _unbounded(problem: Problem, poses: Float[Array, "start dof"]) -> Float[Array, "start parameter"]:
    skeleton = problem.body.skeleton
    z = jnp.zeros((poses.shape[0], problem.scaling.groups.shape[1]), poses.dtype)
    return jnp.concatenate([BoxTransform(skeleton.low, skeleton.high).inv(inside(skeleton, poses)), z], axis=1)


@partial(jax.jit, compiler_options=FAST_COMPILE)
def _thrown(problem: Problem, key: Key, best: Float[Array, "kept parameter"]) -> Float[Array, "start parameter"]:
    """As many starts as before: the best, and copies of them in which the angles of some joints, never the root's, are drawn anew."""
    topology, count = problem.body.skeleton.topology, len(problem.body.dof_names)
    parameters = jnp.tile(best, (-(-STARTS // best.shape[0]), 1))[:STARTS]
    skeleton = problem.body.skeleton
    poses = jax.vmap(BoxTransform(skeleton.low, skeleton.high))(parameters[:, :count])
    which, where = jax.random.split(key)
    joints = jax.random.uniform(which, (STARTS, len(topology.joint_names))) < THROWN
    joints = joints.at[:, 0].set(False).at[: best.shape[0]].set(False)
    owner = {motion.dof: j for j, motions in enumerate(topology.motions) for motion in motions}
    anew = joints[:, jnp.array([owner[k] for k in range(count)])]
    thrown = _unbounded(problem, random_poses(skeleton, where, poses))[:, :count]
    return parameters.at[:, :count].set(jnp.where(anew, thrown, parameters[:, :count]))
