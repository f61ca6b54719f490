"""Refine found poses by likelihoods of the whole body, which bring them nearer to the person, and may exchange the legs and move the arms.

The search has a separate likelihood for each part, and may exchange legs. A likelihood of the whole body can tell the legs apart. The found poses,
and copies with the legs exchanged, therefore become the particles of a filter that sees the frame several times. From round to round the steps of
the dofs get smaller. Particles are weighted with a power of the likelihood, at most 1, that leaves EFFECTIVE of them effective. The poses therefore
stay as diverse as the picture allows.

The later rounds have a sharper likelihood, which counts the pixels of whole silhouettes: it knows best whether an arm or a shoulder is outside the
silhouette or leaves a part of it uncovered. The first rounds are without it, because it tells the legs apart worse.

Before one of the later rounds, arms that stand out are looked for. The joints of the search are those of people who walk, so it finds hanging arms.
Each arm of a pose is therefore compared with arms drawn uniformly within the joint limits. The best of these, and the arm that was found, climb to
their nearest maxima. Another arm is used only if it gains LEAST_GAIN: many arms within the joint limits are in front of the trunk or behind it, where
silhouettes do not distinguish them from a hanging arm.
"""

import re
from collections.abc import Callable, Sequence
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from bayes_body.base.config import FAST_COMPILE
from bayes_body.base.shapes import Key, Pose, Scalar
from bayes_body.density.density import Density
from bayes_body.kernels.batching import everywhere, over_particles
from bayes_body.kernels.smc.tempering import next_increment
from bayes_body.kernels.weights import resampler
from bayes_body.model.body.placement import POSE
from bayes_body.model.body.skeleton import Skeleton
from bayes_body.model.build import Model

# Dofs of an arm. A body with other names keeps its arms.
ARM = "_(clavicle|shoulder|elbow|wrist)"
# Log-likelihood that another arm must gain. Arms of walkers gained 11.2 at most, arms that stand out and were missed 12 to 54.
LEAST_GAIN = 13.0
# Number of drawn arms of each side that climb; and the standard deviations of their steps, degrees.
CLIMB, STEPS_DEG = 11, (10.0, 6.0, 4.0, 2.5, 1.5)

type Dofs = Int[np.ndarray, " own"]
type Poses = Float[np.ndarray, "pose dof"]
type Evaluate = Callable[[Poses], Float[np.ndarray, " pose"]]


def other_arms(
    skeleton: Skeleton, evaluate: Evaluate, best: Float[np.ndarray, " dof"], many: int, random: np.random.Generator
) -> list[tuple[Dofs, Float[np.ndarray, " own"]]]:
    """Return the arms that fit clearly better than those of a pose: their dofs, and the values of these dofs.

    Args:
        skeleton: the body's skeleton.
        evaluate: returns the log-likelihoods of `many` poses; a pose whose value is not finite is not allowed.
        best: the pose.
        many: the number of poses that are evaluated at once.
        random: random generator.
    """
    low, high = np.asarray(skeleton.low, float), np.asarray(skeleton.high, float)
    names = skeleton.topology.dof_names
    sides = [[k for k, name in enumerate(names) if re.match(side + ARM, name) and np.isfinite(high[k] - low[k])] for side in "lr"]
    arms = [np.array(dofs) for dofs in sides if dofs]
    if not arms:
        return []
    drawn = np.tile(best, (len(arms), many // len(arms), 1))
    for poses, dofs in zip(drawn, arms, strict=True):
        poses[:, dofs] = random.uniform(low[dofs], high[dofs], (len(poses), len(dofs)))
    log_likelihoods = _evaluated(evaluate, drawn, many)
    # For each arm: the pose itself, and the best of the drawn ones.
    starts = [
        np.concatenate([best[None], poses[np.argsort(-arm_log_likelihoods)[:CLIMB]]])
        for poses, arm_log_likelihoods in zip(drawn, log_likelihoods, strict=True)
    ]
    taken = list[tuple[Dofs, Float[np.ndarray, " own"]]]()
    poses, values = _climb(np.stack(starts), arms, evaluate, many, (low, high), random)
    for dofs, tops, heights in zip(arms, poses, values, strict=True):
        rival = 1 + int(heights[1:].argmax())
        if heights[rival] > heights[0] + LEAST_GAIN:
            taken.append((dofs, tops[rival, dofs]))
    return taken


def _climb(
    poses: Float[np.ndarray, "arm start dof"],
    arms: Sequence[Dofs],
    evaluate: Evaluate,
    many: int,
    limits: tuple[Float[np.ndarray, " dof"], Float[np.ndarray, " dof"]],
    random: np.random.Generator,
) -> tuple[Float[np.ndarray, "arm start dof"], Float[np.ndarray, "arm start"]]:
    """Move the arm of each pose to the best of many places near it, several times; return the poses and their log-likelihoods."""
    tries, heights = many // (poses.shape[0] * poses.shape[1]), np.full(poses.shape[:2], -np.inf)
    for step in STEPS_DEG:
        candidates = np.repeat(poses[:, None], tries, axis=1)
        for tried, dofs in zip(candidates, arms, strict=True):
            # The first of the tries is the pose itself.
            tried[1:, :, dofs] += np.radians(step) * random.normal(size=(tries - 1, poses.shape[1], len(dofs)))
        candidates = np.clip(candidates, *limits)
        log_likelihoods = _evaluated(evaluate, candidates, many)
        best = log_likelihoods.argmax(axis=1)[:, None]
        poses = np.take_along_axis(candidates, best[..., None], axis=1)[:, 0]
        heights = np.take_along_axis(log_likelihoods, best, axis=1)[:, 0]
    return poses, heights


def _evaluated(evaluate: Evaluate, poses: Float[np.ndarray, "*pose dof"], many: int) -> Float[np.ndarray, "*pose"]:
    """Return the log-likelihoods of `many` poses or fewer, -inf where they are not finite."""
    flat = poses.reshape(-1, poses.shape[-1])
    values = evaluate(np.concatenate([flat, np.repeat(flat[-1:], many - len(flat), axis=0)]))[: len(flat)]
    return np.where(np.isfinite(values), values, -np.inf).reshape(poses.shape[:-1])


# Number of particles, and how many of them are effective.
MANY, EFFECTIVE = 8_192, 96
# The log-weight of a pose that a constraint forbids: finite, because it is multiplied by powers that may be 0.
IMPOSSIBLE = -1e30
# Steps of each round: standard deviations of angles, degrees, and of positions, metres.
ROUNDS = ((10.0, 0.03), (6.0, 0.02), (4.0, 0.015), (3.0, 0.01), (3.0, 0.01), (2.0, 0.007))
# The first round with the sharper likelihood. Before it, arms that stand out are looked for, once the poses are near.
SHARPER_FROM = 2


def refine(
    model: Model, densities: tuple[Density, Density], poses: Float[np.ndarray, "pose dof"], count: int, seed: int
) -> Float[np.ndarray, "draw dof"]:
    """Return `count` equally likely poses, the likeliest one first.

    Args:
        model: the model that will track; its body is placed by angles.
        densities: densities of the frame: of the first rounds, and of those from SHARPER_FROM on.
        poses: the poses, radians and metres; all have the same weight.
        count: number of poses to return.
        seed: random seed.
    """
    random, log_weights, skeleton = np.random.default_rng(seed), jax.jit(_log_weights), model.body.skeleton

    def evaluate(density: Density, poses: Float[np.ndarray, "pose dof"]) -> Float[np.ndarray, " pose"]:
        return np.asarray(log_weights(everywhere(np.asarray(poses, model.body.lengths.dtype)), density), float)

    low, high = np.asarray(skeleton.low, float), np.asarray(skeleton.high, float)
    keys = jax.random.split(jax.random.key(seed), len(ROUNDS) + 1)
    initial_poses, weights = poses, np.zeros(len(poses))
    for number, (key, (step_deg, step_m)) in enumerate(zip(keys, ROUNDS, strict=False)):
        density = densities[number >= SHARPER_FROM]
        best = poses[weights.argmax()]
        poses = poses[np.asarray(resampled(key, weights, MANY))]
        if number == SHARPER_FROM:
            # Half of the particles get the other arm; the likelihood decides.
            for dofs, values in other_arms(skeleton, partial(evaluate, density), best, MANY, random):
                poses[np.ix_(random.random(MANY) < 0.5, dofs)] = values
        steps = np.where(skeleton.topology.angular, np.radians(step_deg), step_m) * random.normal(size=(MANY, len(low)))
        poses = np.clip(poses + steps, low, high)
        weights = evaluate(density, poses)
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
