"""Arms that stand out: a second look at the arms of a pose that was found.

The joints of the search are those of people who walk, so it finds hanging arms. Each arm of a pose is therefore compared with arms drawn from all
that the joint limits allow. The best of these, and the arm that was found, climb to their nearest maxima. Another arm is taken only if it gains
LEAST_GAIN: many of the arms that joint limits allow are in front of the trunk or behind it, where silhouettes do not tell them from a hanging one.
"""

import re
from collections.abc import Callable, Sequence

import numpy as np
from jaxtyping import Float, Int

from bayes_body.model.body.skeleton import Skeleton

# Dofs of an arm. A body with other names keeps its arms.
ARM = "_(clavicle|shoulder|elbow|wrist)"
# Log-likelihood that another arm must gain. Arms of walkers gained 2.6 at most (32 comparisons), an arm that stands out 2.2 to 4.0 (six).
LEAST_GAIN = 3.0
# Of each side, drawn arms that climb; and the standard deviations of their steps, degrees.
CLIMB, STEPS_DEG = 11, (10.0, 6.0, 4.0, 2.5, 1.5)

type Dofs = Int[np.ndarray, " own"]
type Poses = Float[np.ndarray, "pose dof"]
type Evaluate = Callable[[Poses], Float[np.ndarray, " pose"]]


def other_arms(
    skeleton: Skeleton, evaluate: Evaluate, best: Float[np.ndarray, " dof"], many: int, random: np.random.Generator
) -> list[tuple[Dofs, Float[np.ndarray, " own"]]]:
    """Return the arms that fit clearly better than those of a pose: their dofs, and the values of these.

    Args:
        skeleton: the body's skeleton.
        evaluate: returns the log-likelihoods of `many` poses; one that is not finite is not allowed.
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
    # Of each arm: the pose itself, and the best of the drawn ones.
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
        near = np.repeat(poses[:, None], tries, axis=1)
        for tried, dofs in zip(near, arms, strict=True):
            # The first of the tries is the pose itself.
            tried[1:, :, dofs] += np.radians(step) * random.normal(size=(tries - 1, poses.shape[1], len(dofs)))
        near = np.clip(near, *limits)
        log_likelihoods = _evaluated(evaluate, near, many)
        best = log_likelihoods.argmax(axis=1)[:, None]
        poses = np.take_along_axis(near, best[..., None], axis=1)[:, 0]
        heights = np.take_along_axis(log_likelihoods, best, axis=1)[:, 0]
    return poses, heights


def _evaluated(evaluate: Evaluate, poses: Float[np.ndarray, "*pose dof"], many: int) -> Float[np.ndarray, "*pose"]:
    """Return the log-likelihoods of `many` poses or fewer, -inf where they are not finite."""
    flat = poses.reshape(-1, poses.shape[-1])
    values = evaluate(np.concatenate([flat, np.repeat(flat[-1:], many - len(flat), axis=0)]))[: len(flat)]
    return np.where(np.isfinite(values), values, -np.inf).reshape(poses.shape[:-1])
