"""Poses that were found are drawn again by a likelihood of the whole body: they come nearer, and legs may change places.

The search has a likelihood of each part on its own, and may exchange legs. A likelihood of the whole body can tell. So the found poses, and those
with the legs exchanged, become the particles of a filter that sees the frame several times. From round to round the steps of the dofs get smaller.
Particles are weighted with the power of the likelihood with which EFFECTIVE of them are effective, at most 1. So the poses stay apart as far as the
picture allows. Before one of the rounds, arms that stand out are looked for (initial/search/arms.py).
"""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from bayes_body.base.config import FAST_COMPILE
from bayes_body.base.shapes import Key, Pose, Scalar
from bayes_body.density.density import Density
from bayes_body.initial.search.arms import other_arms
from bayes_body.kernels.batching import everywhere, over_particles
from bayes_body.kernels.resampling import resampler
from bayes_body.kernels.smc.ladder import next_increment
from bayes_body.model.body.placement import POSE
from bayes_body.model.build import Model

# Particles, and those of them that are effective.
MANY, EFFECTIVE = 8_192, 96
# The log-weight of a pose that a constraint forbids: finite, because it is multiplied by powers that may be 0.
IMPOSSIBLE = -1e30
# Steps of each round: standard deviations of angles, degrees, and of positions, metres.
ROUNDS = ((10.0, 0.03), (6.0, 0.02), (4.0, 0.015), (3.0, 0.01), (3.0, 0.01))
# The round before which arms that stand out are looked for, once the poses are near.
ARMS_BEFORE = 3


def refine(model: Model, density: Density, poses: Float[np.ndarray, "pose dof"], count: int, seed: int) -> Float[np.ndarray, "draw dof"]:
    """Return `count` equally likely poses, the likeliest one first.

    Args:
        model: the model that will track; its body is placed by angles.
        density: its density of the frame.
        poses: the poses, radians and metres; all count alike.
        count: number of poses to return.
        seed: random seed.
    """
    random, log_weights, skeleton = np.random.default_rng(seed), jax.jit(_log_weights), model.body.skeleton

    def evaluate(poses: Float[np.ndarray, "pose dof"]) -> Float[np.ndarray, " pose"]:
        return np.asarray(log_weights(everywhere(np.asarray(poses, model.body.lengths.dtype)), density), float)

    low, high = np.asarray(skeleton.low, float), np.asarray(skeleton.high, float)
    keys = jax.random.split(jax.random.key(seed), len(ROUNDS) + 1)
    initial_poses, weights = poses, np.zeros(len(poses))
    for number, (key, (step_deg, step_m)) in enumerate(zip(keys, ROUNDS, strict=False)):
        best = poses[weights.argmax()]
        poses = poses[np.asarray(resampled(key, weights, MANY))]
        if number == ARMS_BEFORE:
            # Half of the particles get the other arm; the likelihood decides.
            for dofs, values in other_arms(skeleton, evaluate, best, MANY, random):
                poses[np.ix_(random.random(MANY) < 0.5, dofs)] = values
        steps = np.where(skeleton.topology.angular, np.radians(step_deg), step_m) * random.normal(size=(MANY, len(low)))
        poses = np.clip(poses + steps, low, high)
        weights = evaluate(poses)
        allowed = np.isfinite(weights)
        if not allowed.any():
            return initial_poses[:count]
        # Impossible poses remain among the others, so that shapes do not change and nothing is compiled again.
        weights = np.where(allowed, weights * float(_increment(np.where(allowed, weights, IMPOSSIBLE))), IMPOSSIBLE)
    drawn = np.asarray(resampled(keys[-1], weights, count))
    return poses[drawn[np.argsort(-weights[drawn], kind="stable")]]


@partial(jax.jit, static_argnames="count", compiler_options=FAST_COMPILE)
def resampled(key: Key, log_weights: Float[Array, " pose"], count: int) -> Int[Array, " drawn"]:
    """Return the numbers of `count` poses, drawn systematically by their weights."""
    return resampler("systematic")(key, log_weights, count)


@partial(jax.jit, compiler_options=FAST_COMPILE)
def _increment(log_weights: Float[Array, " pose"]) -> Scalar:
    """Return the power at which EFFECTIVE poses are effective; at most 1."""
    return next_increment(log_weights, EFFECTIVE / MANY, jnp.ones((), log_weights.dtype))


def _log_weights(poses: Float[Array, "pose dof"], density: Density) -> Float[Array, " pose"]:
    """Return the sums of all terms but the motion prior."""

    def log_weight(pose: Pose, density: Density) -> Scalar:
        state = density.transition.begin({POSE: pose})
        return density.log_weight(state, state)

    return over_particles(log_weight, poses, density)
