"""Poses that were found are drawn again, by the likelihood of the model that will track: arms may stand out, and legs may change places.

The search knows a body of parts with the joints of walkers, and a likelihood of each part on its own. It may exchange legs, and it misses arms that
stand out. The model's likelihood sees the whole body. So the found poses, and the same with the legs exchanged, become the particles of a filter that
sees the frame several times. From round to round each dof takes a step, and some particles get an arm that is drawn from all that the joint limits
allow. Particles are weighted with the power of the likelihood with which EFFECTIVE of them are effective, at most 1. So the poses stay apart as far
as the picture allows.
"""

import re

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from bayes_body.body.placement import POSE
from bayes_body.density.density import Density
from bayes_body.kernels.parts.batching import everywhere, over_particles
from bayes_body.kernels.parts.ladder import next_increment
from bayes_body.kernels.parts.resampling import resampler
from bayes_body.model.build import Model
from bayes_body.shapes import Pose, Scalar

# Particles, and those of them that are effective.
MANY, EFFECTIVE = 8_192, 96
# Steps of each round: standard deviations of angles, degrees, and of positions, metres; share of the particles that get another arm.
ROUNDS = ((10.0, 0.03, 0.5), (6.0, 0.02, 0.5), (4.0, 0.015, 0.5), (3.0, 0.01, 0.3), (3.0, 0.01, 0.0))
# Dofs of an arm. A body with other names keeps its arms.
ARM = re.compile(r"[lr]_(clavicle|shoulder|elbow|wrist)")


def refine(model: Model, density: Density, poses: Float[np.ndarray, "pose dof"], count: int, seed: int) -> Float[np.ndarray, "draw dof"]:
    """Return `count` equally likely poses, the likeliest one first.

    Args:
        model: the model that will track; its body is placed by angles.
        density: its density of the frame.
        poses: the poses, radians and metres; all count alike.
        count: number of poses to return.
        seed: random seed.
    """
    random, resample, evaluate = np.random.default_rng(seed), resampler("systematic"), jax.jit(_log_weights)
    keys = jax.random.split(jax.random.key(seed), len(ROUNDS) + 1)
    found, weights = poses, np.zeros(len(poses))
    for key, (step_deg, step_m, arms) in zip(keys, ROUNDS, strict=False):
        poses = _moved(model, poses[np.asarray(resample(key, jnp.asarray(weights), MANY))], step_deg, step_m, arms, random)
        weights = np.asarray(evaluate(everywhere(jnp.asarray(poses, model.body.lengths.dtype)), density), float)
        allowed = np.isfinite(weights)
        if not allowed.any():
            return found[:count]
        poses, weights = poses[allowed], weights[allowed]
        weights = weights * float(next_increment(jnp.asarray(weights), min(1.0, EFFECTIVE / len(weights)), jnp.asarray(1.0)))
    drawn = np.asarray(resample(keys[-1], jnp.asarray(weights), count))
    return poses[drawn[np.argsort(-weights[drawn], kind="stable")]]


def _log_weights(poses: Float[Array, "pose dof"], density: Density) -> Float[Array, " pose"]:
    """Return the sums of all terms but the motion prior."""

    def one(pose: Pose, density: Density) -> Scalar:
        state = density.transition.begin({POSE: pose})
        return density.log_weight(state, state)

    return over_particles(one, poses, density)


def _moved(
    model: Model, poses: Float[np.ndarray, "pose dof"], step_deg: float, step_m: float, arms: float, random: np.random.Generator
) -> Float[np.ndarray, "pose dof"]:
    """Return the poses after a step, some of them with another arm, inside the joint limits."""
    topology, low, high = model.body.skeleton.topology, np.asarray(model.body.skeleton.low, float), np.asarray(model.body.skeleton.high, float)
    steps = np.where(topology.angular, np.radians(step_deg), step_m)
    moved = poses + steps * random.normal(size=poses.shape)
    sides = random.choice(3, len(poses), p=(arms / 2, arms / 2, 1 - arms))
    for number, side in enumerate(("l_", "r_")):
        own = [k for k, name in enumerate(topology.dof_names) if name.startswith(side) and ARM.match(name) and np.isfinite(high[k] - low[k])]
        drawn = random.uniform(low[own], high[own], (len(poses), len(own)))
        moved[:, own] = np.where((sides == number)[:, None], drawn, moved[:, own])
    return np.clip(moved, low, high)
