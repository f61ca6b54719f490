r"""A motion prior by a learned activity (Darby, Li & Costen 2008, 4 to 6): a hidden Markov model moves through a subspace of the joint angles.

Sampled are the features f, the residual r, and what is free: position $\tau$, orientation $\theta$ and the head. The pose is derived,

$$s = \mathrm{clip}(m + \bar\epsilon + \Phi f + r,\ \mathrm{low},\ \mathrm{high}),$$

with the mean pose m of a known subject, or the average of all. One learned file serves two readings; the kernel chooses.

**As a density**, which posterior samplers use. A particle carries the probabilities a of the hidden states, given its features so far:

$$p(f_t \mid a_{t-1}) = \sum_j (a_{t-1} A)_j\, N(f_t; \mu_j, \Sigma_j), \qquad a_{t,j} \propto (a_{t-1} A)_j\, N(f_t; \mu_j, \Sigma_j).$$

The residual, which the paper lacks, is an autoregressive process of first order with the standard deviation of what the features leave. For an
unknown subject, the spread of the subjects' mean poses is added. The free variables are a random walk; the position may keep a share of its step.

**As the paper's proposal**, which annealing kernels use (`explore`). In layer r, with $\lambda = \tau^{R-r}$, the most likely state i of f makes

$$K_i^r = \lceil \log(1 - \lambda \rho_T) / \log A_{ii} \rceil \qquad (12)$$

transitions, at least one, and the state j that it reaches emits f from $N(\mu_j, \lambda \Sigma_j)$. If $j = i$ after the first layer, the mean is
the particle's own f. The free variables get noise with $\lambda$ times their standard deviation (10).
"""

import math
from typing import Annotated, Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from numpyro.distributions import Categorical, Distribution, MixtureSameFamily, MultivariateNormal, Normal
from pydantic import Field

from bayes_body.body.branches import nearest_branch
from bayes_body.body.placement import POSE, require
from bayes_body.body.settled import settled
from bayes_body.body.solids import Body
from bayes_body.body.space import pose_space
from bayes_body.density.factor import State, Transition
from bayes_body.density.spaces import Space, circle, euclidean
from bayes_body.dynamics.activity import NAME, Activity, load_activity
from bayes_body.errors import input_error, nearest
from bayes_body.registry import register
from bayes_body.shapes import Key, Pose, Scalar
from bayes_body.toml.schema import Positive, Schema, Share

FEATURES, BELIEF, RESIDUAL, BEFORE = "features", "belief", "residual", "position_before"
# The free variables, and where they are in the pose. The rest of the free dofs is the head.
POSITION, ORIENTATION, HEAD = "position", "orientation", "head"
ROOT = 6
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
    subject: str | None = None
    temperature: Temperature = 0.0
    residual: bool = True
    residual_s: Positive = 1.0
    momentum: Share = 0.0
    position_sd_m: Positive | None = None
    orientation_sd_deg: Positive | None = None
    head_sd_deg: Positive | None = None
    at_fps: Positive = 60.0


class _Arrays(NamedTuple):
    """The arrays of the prior.

    `mean`: pose of the learned dofs for f = 0 and r = 0. `transition`, `locations` and `factor` (Cholesky factors of the covariances): the hidden
    Markov model at the frame rate. `sd`: of the free variables and the residual, per frame. `keep`: what remains of a residual after a frame.
    `learned`, `head`: where these dofs are in the pose. `steps`: as many entries as the state that stays longest needs transitions at the full
    temperature.
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
    keep: Scalar
    steps: Float[Array, " transition"]
    sd: State


def _derive(arrays: _Arrays, sampled: State) -> dict[str, Array]:
    joints = arrays.mean + arrays.basis @ sampled[FEATURES] + sampled.get(RESIDUAL, 0.0)
    pose = jnp.zeros_like(arrays.low).at[:ROOT].set(jnp.concatenate([sampled[POSITION], sampled[ORIENTATION]]))
    pose = pose.at[arrays.learned].set(joints)
    if HEAD in sampled:
        pose = pose.at[arrays.head].set(sampled[HEAD])
    return {POSE: jnp.clip(pose, arrays.low, arrays.high)}


def _emissions(arrays: _Arrays, features: Array) -> Float[Array, " state"]:
    """Return log N(f; μ, Σ) for each state."""
    return MultivariateNormal(arrays.locations, scale_tril=arrays.factor).log_prob(features)


def _conditional(arrays: _Arrays, previous: State) -> dict[str, Distribution]:
    ahead = previous[BELIEF] @ arrays.transition
    emitted = MultivariateNormal(arrays.locations, scale_tril=arrays.factor)
    step = previous[POSITION] - previous.get(BEFORE, previous[POSITION])
    found: dict[str, Distribution] = {
        FEATURES: MixtureSameFamily(Categorical(probs=ahead), emitted),
        POSITION: _normal(previous[POSITION] + arrays.momentum * step, arrays.sd[POSITION]),
        ORIENTATION: _normal(previous[ORIENTATION], arrays.sd[ORIENTATION]),
    }
    if HEAD in arrays.sd:
        found[HEAD] = _normal(previous[HEAD], arrays.sd[HEAD])
    if RESIDUAL in arrays.sd:
        found[RESIDUAL] = _normal(arrays.keep * previous[RESIDUAL], arrays.sd[RESIDUAL])
    return found


def _carry(arrays: _Arrays, previous: State, known: State) -> dict[str, Array]:
    """Add the probabilities of the states, and the position that the next step starts from."""
    ahead = jnp.log(previous[BELIEF] @ arrays.transition + jnp.finfo(arrays.mean.dtype).tiny)
    return {**known, BELIEF: jax.nn.softmax(ahead + _emissions(arrays, known[FEATURES])), BEFORE: previous[POSITION]}


def _perturbation(arrays: _Arrays, state: State, scale: Scalar) -> dict[str, Distribution]:
    """Noise around a state: of the most likely hidden state for the features."""
    active = jnp.argmax(_emissions(arrays, state[FEATURES]))
    around = MultivariateNormal(state[FEATURES], scale_tril=jnp.sqrt(scale) * arrays.factor[active])
    return {FEATURES: around, **{name: _normal(state[name], sd * scale) for name, sd in arrays.sd.items()}}


def _explore(arrays: _Arrays, key: Key, state: State, previous: State, scale: Scalar) -> dict[str, Array]:
    """Return sampled variables of the paper's proposal at one layer."""
    del previous
    walk_key, emit_key, *keys = jax.random.split(key, 2 + len(arrays.sd))
    start = jnp.argmax(_emissions(arrays, state[FEATURES]))
    needed = _transitions(arrays.transition[start, start], arrays.temperature * scale)

    def step(active: Array, number_and_key: tuple[Array, Key]) -> tuple[Array, None]:
        number, step_key = number_and_key
        moved = jax.random.categorical(step_key, jnp.log(arrays.transition[active]))
        return jnp.where(number < needed, moved, active), None

    most = len(arrays.steps)
    reached, _ = jax.lax.scan(step, start, (jnp.arange(most), jax.random.split(walk_key, most)))
    centre = jnp.where((reached == start) & (scale < 1), state[FEATURES], arrays.locations[reached])
    noise = arrays.factor[reached] @ jax.random.normal(emit_key, centre.shape, centre.dtype)
    free = zip(arrays.sd.items(), keys, strict=True)
    moved = {name: state[name] + scale * sd * jax.random.normal(each, state[name].shape, centre.dtype) for (name, sd), each in free}
    return {FEATURES: centre + jnp.sqrt(scale) * noise, **moved}


def _transitions(stays: Array, temperature: Scalar | float) -> Array:
    """Return K of (12), at least 1."""
    return jnp.maximum(jnp.ceil(jnp.log1p(-temperature) / jnp.log(jnp.clip(stays, LEAVES, STAYS))), 1)


def _normal(centre: Array, sd: Array) -> Distribution:
    return Normal(centre, jnp.broadcast_to(sd, centre.shape)).to_event(1)


def _begin(arrays: _Arrays, body: Body, first: State) -> dict[str, Array]:
    """Return the state of a first pose: its features, what they leave, and the probabilities of the hidden states."""
    given = jnp.asarray(first[POSE], arrays.mean.dtype)
    reference = given.at[arrays.learned].set(arrays.mean)
    pose = settled(body, nearest_branch(body.skeleton.topology, given, reference)(given))
    away = pose[arrays.learned] - arrays.mean
    features = arrays.basis.T @ away
    state = {FEATURES: features, POSITION: pose[:3], ORIENTATION: pose[3:ROOT], BEFORE: pose[:3]}
    state[BELIEF] = jax.nn.softmax(jnp.log(arrays.initial + jnp.finfo(features.dtype).tiny) + _emissions(arrays, features))
    if HEAD in arrays.sd:
        state[HEAD] = pose[arrays.head]
    if RESIDUAL in arrays.sd:
        state[RESIDUAL] = away - arrays.basis @ features
    return state | _derive(arrays, state)


@register("dynamics", "activity_hmm", Options)
def build(options: Options, body: Body, fps: float, **_: Any) -> Transition:
    """Build the prior for one body and frame rate. It ignores the session's standard deviations of changes between frames, which are not its noise.

    Raises:
        InputError: the activity cannot be read, is of another body or of people without this subject, or its frame rate is no multiple of `fps`.
    """
    require(body, POSE, "dynamics 'activity_hmm'", 'kind = "rigid_walk"')
    activity = load_activity(options.activity)
    _check(activity, body)
    arrays = _arrays(options, activity, body, fps)
    partial = jax.tree_util.Partial
    return Transition(
        "activity_hmm",
        partial(_conditional, arrays),
        partial(_perturbation, arrays),
        carry=partial(_carry, arrays),
        begin=partial(_begin, arrays, body),
        derive=partial(_derive, arrays),
        explore=partial(_explore, arrays),
        spaces=_spaces(activity, body),
    )


def _spaces(activity: Activity, body: Body) -> tuple[tuple[str, Space], ...]:
    names, features, states = body.dof_names, activity.basis.shape[1], len(activity.labels)
    head = tuple(name for name in names[ROOT:] if name not in activity.names)
    return (
        (POSE, pose_space(body)),
        (FEATURES, euclidean(tuple(f"feature_{k + 1}" for k in range(features)), ("rad",) * features, "feature")),
        (POSITION, euclidean(names[:3], ("m",) * 3, "shift")),
        (ORIENTATION, circle(names[3:ROOT], "turn")),
        (HEAD, euclidean(head, ("rad",) * len(head), "head_dof")),
        (RESIDUAL, euclidean(tuple(f"residual_{name}" for name in activity.names), ("rad",) * len(activity.names), "joint_dof")),
        (BELIEF, euclidean(tuple(f"{label}_{k + 1}" for k, label in enumerate(activity.labels)), ("",) * states, "state")),
        (BEFORE, euclidean(tuple(f"{name}_before" for name in names[:3]), ("m",) * 3, "shift_before")),
    )


def _check(activity: Activity, body: Body) -> None:
    names = body.dof_names
    root = body.skeleton.topology.motions[0]
    missing = [name for name in activity.names if name not in names[ROOT:]]
    if missing or len(activity.change) != len(names) or [motion.dof for motion in root] != list(range(ROOT)):
        found = f"learned on the body '{activity.body}'; the model's body '{body.name}' has other dofs" + (
            f", without {missing[0]}" if missing else ""
        )
        raise input_error("dynamics.activity", found, "an activity of the model's body", "learn one with `bayes-body learn activity-hmm --body`")


def _mean(options: Options, activity: Activity) -> tuple[np.ndarray, np.ndarray]:
    """Return the mean pose, and the standard deviation of what separates the tracked person's from it."""
    if options.subject is None:
        return activity.means.mean(axis=0), activity.between
    if options.subject not in activity.subjects:
        found = f"'{options.subject}' is not among its people; {nearest(options.subject, activity.subjects)}"
        raise input_error("dynamics.subject", found, "one of " + ", ".join(activity.subjects), "leave it out for a person who is not among them")
    return activity.means[activity.subjects.index(options.subject)], np.zeros_like(activity.between)


def _frames(activity: Activity, fps: float) -> int:
    """Return how many frames of the activity a frame of the session takes."""
    frames = round(activity.fps / fps)
    if frames < 1 or abs(activity.fps / fps / frames - 1) > ROUNDING:
        found = f"learned at {activity.fps:g} frames per second, and the session has {fps:g}"
        raise input_error(
            "dynamics.activity", found, "the session's rate, or a multiple", f"learn one with `bayes-body learn activity-hmm --fps {fps:g}`"
        )
    return frames


def _arrays(options: Options, activity: Activity, body: Body, fps: float) -> _Arrays:
    dtype, frames, names = body.lengths.dtype, _frames(activity, fps), body.dof_names
    mean, between = _mean(options, activity)
    learned = np.array([names.index(name) for name in activity.names])
    head = np.array([k for k in range(ROOT, len(names)) if k not in learned], int)
    transition = np.linalg.matrix_power(activity.transition / activity.transition.sum(axis=1, keepdims=True), frames)
    # A dof that no marker shows did not move in training.
    change, given = np.maximum(activity.change, LEAST_CHANGE) * math.sqrt(frames), math.sqrt(options.at_fps / fps)
    own = {POSITION: options.position_sd_m, ORIENTATION: options.orientation_sd_deg, HEAD: options.head_sd_deg}
    # The training motions went one way; a person may walk in any direction.
    change[:2] = change[:2].max()
    sd = {name: change[at] for name, at in ((POSITION, slice(0, 3)), (ORIENTATION, slice(3, ROOT)), (HEAD, head))}
    sd |= {name: value * given * (1.0 if name == POSITION else math.radians(1.0)) for name, value in own.items() if value is not None}
    if not head.size:
        del sd[HEAD]
    keep = math.exp(-1 / (fps * options.residual_s))
    if options.residual:
        sd[RESIDUAL] = np.sqrt((activity.residual**2 + between**2) * (1 - keep**2))
    most = int(_transitions(jnp.asarray(np.diagonal(transition)), options.temperature).max())
    numbers = {
        "mean": mean + activity.centre,
        "basis": activity.basis,
        "initial": activity.initial,
        "transition": transition,
        "locations": activity.locations,
        "factor": np.linalg.cholesky(activity.covariances),
        "temperature": options.temperature,
        "momentum": options.momentum,
        "keep": keep,
        "steps": np.zeros(most),
    }
    arrays = {name: jnp.asarray(value, dtype) for name, value in numbers.items()}
    return _Arrays(
        **arrays,
        low=body.skeleton.low,
        high=body.skeleton.high,
        learned=jnp.asarray(learned),
        head=jnp.asarray(head),
        sd={name: jnp.asarray(value, dtype) for name, value in sd.items()},
    )
