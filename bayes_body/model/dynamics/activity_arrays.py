"""Options of the motion prior `activity_hmm`, and the arrays that follow from them, from an activity and from a body."""

import math
from typing import Annotated, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from numpyro.distributions import MultivariateNormal
from pydantic import Field

from bayes_body.base.errors import input_error, nearest
from bayes_body.base.shapes import Pose, Scalar
from bayes_body.base.toml.schema import Positive, Schema, Share
from bayes_body.density.factor import State
from bayes_body.density.spaces import Space, circle, euclidean
from bayes_body.model.body.placement import POSE
from bayes_body.model.body.solids import Body, pose_space
from bayes_body.model.dynamics.activity import NAME, Activity
from bayes_body.model.dynamics.diffusion import ROOT_DOFS, check_root

FEATURES, BELIEF, RESIDUAL, BEFORE = "features", "belief", "residual", "position_before"
# The free variables, and where they are in the pose. The rest of the free dofs is the head.
POSITION, ORIENTATION, HEAD = "position", "orientation", "head"
# The probability of staying in a state is taken as at least and at most this: (12) divides by its logarithm.
LEAVES, STAYS = 1e-6, 0.999
# Standard deviations from the training motions are at least this, metres and radians per frame.
LEAST_CHANGE = 1e-3
# The frame rate may be a whole fraction of the activity's, up to this.
ROUNDING = 1e-3


Temperature = Annotated[float, Field(strict=True, ge=0, lt=1)]


class Options(Schema):
    """Options of `[dynamics] kind = "activity_hmm"`. Standard deviations of None are those of the activity's file."""

    activity: str = NAME
    """a name in `models/learned/`, or the path of an `.npz` of `bayes-body learn activity-hmm`."""
    subject: str | None = None
    """a person that the activity was learned from: their mean pose is used. Without it, the average of all, and the residual is as wide as people
    differ."""
    temperature: Temperature = 0.0
    """for `annealed`: the least probability of a change of state in the first layer. More is for images that say little: the activity goes on."""
    residual: bool = True
    """false, as in the paper: the pose is the activity's exactly, and the posterior is too narrow."""
    residual_s: Positive = 1.0
    """[s] time in which a residual decays to 1/e; its standard deviation is the activity's."""
    momentum: Share = 0.0
    """share of the last step that the position keeps; 0: a random walk."""
    momentum_aside: Share | None = None
    """the same for the part of the last step across the direction in which the pelvis faces; none: the same share. With less, a walker goes
    where the pelvis faces, so that the turn of the body tells one camera how fast it comes nearer."""
    position_sd_m: Positive | None = None
    """[metres per frame] noise of the position; none: half the largest change between two frames of the training motions."""
    orientation_sd_deg: Positive | None = None
    """[degrees per frame] noise of yaw, roll and pitch; none: likewise."""
    head_sd_deg: Positive | None = None
    """[degrees per frame] noise of the dofs that the activity does not have; none: likewise."""
    at_fps: Positive = 60.0
    """[1/s] frame rate to which these three values apply; at another frame rate they scale with the square root of the time between frames."""


class ActivityArrays(NamedTuple):
    """The arrays of the prior.

    `mean`: pose of the learned dofs for f = 0 and r = 0. `transition`, `locations` and `factor` (Cholesky factors of the covariances): the hidden
    Markov model at the frame rate. `sd`: of the free variables and the residual, per frame. `keep`: what remains of a residual after a frame.
    `first_step`: standard deviation of the step before the first frame. `learned`, `head`: where these dofs are in the pose. `steps`: as many entries
    as the state that stays longest needs transitions at the full temperature.
    """

    mean: Float[Array, " dof"]
    basis: Float[Array, "dof feature"]
    initial: Float[Array, " state"]
    transition: Float[Array, "state state"]
    locations: Float[Array, "state feature"]
    factor: Float[Array, "state feature feature"]
    low: Pose
    high: Pose
    learned: Array
    head: Array
    temperature: Scalar
    momentum: Scalar
    momentum_aside: Scalar
    first_step: Float[Array, "3"]
    keep: Scalar
    steps: Float[Array, " transition"]
    sd: State


def transitions_needed(stays: Array, temperature: Scalar | float) -> Array:
    """Return K of (12), at least 1."""
    return jnp.maximum(jnp.ceil(jnp.log1p(-temperature) / jnp.log(jnp.clip(stays, LEAVES, STAYS))), 1)


def activity_spaces(activity: Activity, body: Body) -> tuple[tuple[str, Space], ...]:
    """Return where the variables of the state live."""
    names, features, states = body.dof_names, activity.basis.shape[1], len(activity.labels)
    head = tuple(name for name in names[ROOT_DOFS:] if name not in activity.names)
    return (
        (POSE, pose_space(body)),
        (FEATURES, euclidean(tuple(f"feature_{k + 1}" for k in range(features)), ("rad",) * features, "feature")),
        (POSITION, euclidean(names[:3], ("m",) * 3, "shift")),
        (ORIENTATION, circle(names[3:ROOT_DOFS], "turn")),
        (HEAD, euclidean(head, ("rad",) * len(head), "head_dof")),
        (RESIDUAL, euclidean(tuple(f"residual_{name}" for name in activity.names), ("rad",) * len(activity.names), "joint_dof")),
        (BELIEF, euclidean(tuple(f"{label}_{k + 1}" for k, label in enumerate(activity.labels)), ("",) * states, "state")),
        (BEFORE, euclidean(tuple(f"{name}_before" for name in names[:3]), ("m",) * 3, "shift_before")),
    )


def check_activity(activity: Activity, body: Body) -> None:
    """Check that a body has the dofs of an activity.

    Raises:
        InputError: its first joint is no root of six dofs, or a learned dof is missing.
    """
    check_root(body, "dynamics activity_hmm")
    missing = [name for name in activity.names if name not in body.dof_names[ROOT_DOFS:]]
    if missing or len(activity.change) != len(body.dof_names):
        without = f", without {missing[0]}" if missing else ""
        problem = f"learned on the body '{activity.body}'; the model's body '{body.name}' has other dofs{without}"
        raise input_error("dynamics.activity", problem, "an activity of the model's body", "learn one with `bayes-body learn activity-hmm --body`")


def _mean(options: Options, activity: Activity) -> tuple[np.ndarray, np.ndarray]:
    """Return the mean pose, and the standard deviation of what separates the tracked person's from it."""
    if options.subject is None:
        return activity.means.mean(axis=0), activity.between
    if options.subject not in activity.subjects:
        problem = f"'{options.subject}' is not among its people; {nearest(options.subject, activity.subjects)}"
        raise input_error("dynamics.subject", problem, "one of " + ", ".join(activity.subjects), "leave it out for a person who is not among them")
    return activity.means[activity.subjects.index(options.subject)], np.zeros_like(activity.between)


def _frames(activity: Activity, fps: float) -> int:
    """Return how many frames of the activity a frame of the session takes."""
    frames = round(activity.fps / fps)
    if frames < 1 or abs(activity.fps / fps / frames - 1) > ROUNDING:
        problem = f"learned at {activity.fps:g} frames per second, and the session has {fps:g}"
        remedy = f"learn one with `bayes-body learn activity-hmm --fps {fps:g}`"
        raise input_error("dynamics.activity", problem, "the session's rate, or a multiple", remedy)
    return frames


def activity_arrays(options: Options, activity: Activity, body: Body, fps: float) -> ActivityArrays:
    """Return the arrays for one body and frame rate.

    Raises:
        InputError: the activity has not this subject, or its frame rate is no multiple of `fps`.
    """
    dtype, frames, names = body.lengths.dtype, _frames(activity, fps), body.dof_names
    mean, between = _mean(options, activity)
    learned = np.array([names.index(name) for name in activity.names])
    head = np.array([k for k in range(ROOT_DOFS, len(names)) if k not in learned], int)
    transition = np.linalg.matrix_power(activity.transition / activity.transition.sum(axis=1, keepdims=True), frames)
    # A dof that no marker shows did not move in training.
    change, rate_factor = np.maximum(activity.change, LEAST_CHANGE) * math.sqrt(frames), math.sqrt(options.at_fps / fps)
    option_sds = {POSITION: options.position_sd_m, ORIENTATION: options.orientation_sd_deg, HEAD: options.head_sd_deg}
    # The training motions went one way; a person may walk in any direction.
    change[:2] = change[:2].max()
    sd = {name: change[index] for name, index in ((POSITION, slice(0, 3)), (ORIENTATION, slice(3, ROOT_DOFS)), (HEAD, head))}
    sd |= {name: value * rate_factor * (1.0 if name == POSITION else math.radians(1.0)) for name, value in option_sds.items() if value is not None}
    first_step = frames * np.maximum(activity.change[:3], LEAST_CHANGE)
    first_step[:2] = first_step[:2].max()
    if not head.size:
        del sd[HEAD]
    keep = math.exp(-1 / (fps * options.residual_s))
    if options.residual:
        sd[RESIDUAL] = np.sqrt((activity.residual**2 + between**2) * (1 - keep**2))
    most = int(transitions_needed(jnp.asarray(np.diagonal(transition)), options.temperature).max())
    numbers = {
        "mean": mean + activity.centre,
        "basis": activity.basis,
        "initial": activity.initial,
        "transition": transition,
        "locations": activity.locations,
        "factor": np.linalg.cholesky(activity.covariances),
        "temperature": options.temperature,
        "momentum": options.momentum,
        "momentum_aside": options.momentum if options.momentum_aside is None else options.momentum_aside,
        "first_step": first_step,
        "keep": keep,
        "steps": np.zeros(most),
    }
    arrays = {name: jnp.asarray(value, dtype) for name, value in numbers.items()}
    return ActivityArrays(
        **arrays,
        low=body.skeleton.low,
        high=body.skeleton.high,
        learned=jnp.asarray(learned),
        head=jnp.asarray(head),
        sd={name: jnp.asarray(value, dtype) for name, value in sd.items()},
    )


def derive_pose(arrays: ActivityArrays, sampled: State) -> dict[str, Array]:
    """Return the pose of the sampled variables, within the joint limits."""
    joints = arrays.mean + arrays.basis @ sampled[FEATURES] + sampled.get(RESIDUAL, 0.0)
    pose = jnp.zeros_like(arrays.low).at[:ROOT_DOFS].set(jnp.concatenate([sampled[POSITION], sampled[ORIENTATION]]))
    pose = pose.at[arrays.learned].set(joints)
    if HEAD in sampled:
        pose = pose.at[arrays.head].set(sampled[HEAD])
    return {POSE: jnp.clip(pose, arrays.low, arrays.high)}


def log_emissions(arrays: ActivityArrays, features: Array) -> Float[Array, " state"]:
    """Return log N(f; μ, Σ) for each state."""
    return MultivariateNormal(arrays.locations, scale_tril=arrays.factor).log_prob(features)
