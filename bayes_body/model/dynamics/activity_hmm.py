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
the particle's own f. The free variables get noise with $\lambda$ times their standard deviation (10). The first layer adds the share of its step
that the position keeps; the paper has none.
"""

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float
from numpyro.distributions import Categorical, Distribution, LowRankMultivariateNormal, MixtureSameFamily, MultivariateNormal, Normal

from bayes_body.base.registry import register
from bayes_body.base.shapes import Key, Scalar
from bayes_body.density.factor import State, Transition
from bayes_body.model.body.branches import nearest_branch, settled
from bayes_body.model.body.placed_body import require
from bayes_body.model.body.placement import POSE
from bayes_body.model.body.solids import Body
from bayes_body.model.dynamics.activity import load_activity
from bayes_body.model.dynamics.activity_arrays import (
    BEFORE,
    BELIEF,
    FEATURES,
    HEAD,
    ORIENTATION,
    POSITION,
    RESIDUAL,
    ActivityArrays,
    Options,
    activity_arrays,
    activity_spaces,
    check_activity,
    transitions_needed,
)
from bayes_body.model.dynamics.diffusion import ROOT_DOFS


def _derive(arrays: ActivityArrays, sampled: State) -> dict[str, Array]:
    joints = arrays.mean + arrays.basis @ sampled[FEATURES] + sampled.get(RESIDUAL, 0.0)
    pose = jnp.zeros_like(arrays.low).at[:ROOT_DOFS].set(jnp.concatenate([sampled[POSITION], sampled[ORIENTATION]]))
    pose = pose.at[arrays.learned].set(joints)
    if HEAD in sampled:
        pose = pose.at[arrays.head].set(sampled[HEAD])
    return {POSE: jnp.clip(pose, arrays.low, arrays.high)}


def _emissions(arrays: ActivityArrays, features: Array) -> Float[Array, " state"]:
    """Return log N(f; μ, Σ) for each state."""
    return MultivariateNormal(arrays.locations, scale_tril=arrays.factor).log_prob(features)


def _conditional(arrays: ActivityArrays, previous: State) -> dict[str, Distribution]:
    belief = previous[BELIEF] @ arrays.transition
    emitted = MultivariateNormal(arrays.locations, scale_tril=arrays.factor)
    step = previous[POSITION] - previous.get(BEFORE, previous[POSITION])
    distributions: dict[str, Distribution] = {
        FEATURES: MixtureSameFamily(Categorical(probs=belief), emitted),
        POSITION: _normal(previous[POSITION] + arrays.momentum * step, arrays.sd[POSITION]),
        ORIENTATION: _normal(previous[ORIENTATION], arrays.sd[ORIENTATION]),
    }
    if HEAD in arrays.sd:
        distributions[HEAD] = _normal(previous[HEAD], arrays.sd[HEAD])
    if RESIDUAL in arrays.sd:
        distributions[RESIDUAL] = _normal(arrays.keep * previous[RESIDUAL], arrays.sd[RESIDUAL])
    return distributions


def _carry(arrays: ActivityArrays, previous: State, sampled: State) -> dict[str, Array]:
    """Add the probabilities of the states, and the position that the next step starts from."""
    log_belief = jnp.log(previous[BELIEF] @ arrays.transition + jnp.finfo(arrays.mean.dtype).tiny)
    return {**sampled, BELIEF: jax.nn.softmax(log_belief + _emissions(arrays, sampled[FEATURES])), BEFORE: previous[POSITION]}


def _perturbation(arrays: ActivityArrays, state: State, scale: Scalar) -> dict[str, Distribution]:
    """Noise around a state: of the most likely hidden state for the features."""
    active = jnp.argmax(_emissions(arrays, state[FEATURES]))
    feature_noise = MultivariateNormal(state[FEATURES], scale_tril=jnp.sqrt(scale) * arrays.factor[active])
    return {FEATURES: feature_noise, **{name: _normal(state[name], sd * scale) for name, sd in arrays.sd.items()}}


def _explore(arrays: ActivityArrays, key: Key, state: State, previous: State, scale: Scalar) -> dict[str, Array]:
    """Return sampled variables of the paper's proposal at one layer."""
    walk_key, emit_key, *keys = jax.random.split(key, 2 + len(arrays.sd))
    start = jnp.argmax(_emissions(arrays, state[FEATURES]))
    needed = transitions_needed(arrays.transition[start, start], arrays.temperature * scale)

    def step(active: Array, number_and_key: tuple[Array, Key]) -> tuple[Array, None]:
        number, step_key = number_and_key
        moved = jax.random.categorical(step_key, jnp.log(arrays.transition[active]))
        return jnp.where(number < needed, moved, active), None

    most = len(arrays.steps)
    reached, _ = jax.lax.scan(step, start, (jnp.arange(most), jax.random.split(walk_key, most)))
    centre = jnp.where((reached == start) & (scale < 1), state[FEATURES], arrays.locations[reached])
    noise = arrays.factor[reached] @ jax.random.normal(emit_key, centre.shape, centre.dtype)
    free = zip(arrays.sd.items(), keys, strict=True)
    moved = {name: state[name] + scale * sd * jax.random.normal(noise_key, state[name].shape, centre.dtype) for (name, sd), noise_key in free}
    moved[POSITION] += jnp.where(scale < 1, 0.0, arrays.momentum) * (previous[POSITION] - previous[BEFORE])
    return {FEATURES: centre + jnp.sqrt(scale) * noise, **moved}


def _normal(centre: Array, sd: Array) -> Distribution:
    return Normal(centre, jnp.broadcast_to(sd, centre.shape)).to_event(1)


def _features_of(arrays: ActivityArrays, deviation: Float[Array, " dof"]) -> Float[Array, " feature"]:
    """Return the features of a first pose.

    Without a residual these are its projection. With one, they are the most probable ones under the state that explains the pose best: a projection
    far from all states would be left in the first frame, and the pose with it, because the residual changes slowly.
    """
    if RESIDUAL not in arrays.sd:
        return arrays.basis.T @ deviation
    spread = jnp.square(arrays.sd[RESIDUAL]) / (1 - jnp.square(arrays.keep))
    explained = LowRankMultivariateNormal(arrays.locations @ arrays.basis.T, arrays.basis @ arrays.factor, spread).log_prob(deviation)
    best = jnp.argmax(jnp.log(arrays.initial) + explained)
    covariance = arrays.factor[best] @ arrays.factor[best].T
    gain = covariance @ arrays.basis.T @ jnp.linalg.inv(arrays.basis @ covariance @ arrays.basis.T + jnp.diag(spread))
    return arrays.locations[best] + gain @ (deviation - arrays.basis @ arrays.locations[best])


@jax.jit
def _begin(arrays: ActivityArrays, body: Body, first: State) -> dict[str, Array]:
    """Return the state of a first pose: its features, what they leave, and the probabilities of the hidden states."""
    first_pose = jnp.asarray(first[POSE], arrays.mean.dtype)
    reference = first_pose.at[arrays.learned].set(arrays.mean)
    pose = settled(body, nearest_branch(body.skeleton.topology, first_pose, reference)(first_pose))
    deviation = pose[arrays.learned] - arrays.mean
    features = _features_of(arrays, deviation)
    state = {FEATURES: features, POSITION: pose[:3], ORIENTATION: pose[3:ROOT_DOFS], BEFORE: pose[:3]}
    state[BELIEF] = jax.nn.softmax(jnp.log(arrays.initial + jnp.finfo(features.dtype).tiny) + _emissions(arrays, features))
    if HEAD in arrays.sd:
        state[HEAD] = pose[arrays.head]
    if RESIDUAL in arrays.sd:
        state[RESIDUAL] = deviation - arrays.basis @ features
    return state | _derive(arrays, state)


@register("dynamics", "activity_hmm", Options)
def build(options: Options, body: Body, fps: float, **_: Any) -> Transition:
    """Build the prior for one body and frame rate. It ignores the session's standard deviations of changes between frames, which are not its noise.

    Raises:
        InputError: the activity cannot be read, is of another body or of people without this subject, or its frame rate is no multiple of `fps`.
    """
    require(body, POSE, "dynamics 'activity_hmm'", 'kind = "rigid_walk"')
    activity = load_activity(options.activity)
    check_activity(activity, body)
    arrays = activity_arrays(options, activity, body, fps)
    partial = jax.tree_util.Partial
    return Transition(
        "activity_hmm",
        partial(_conditional, arrays),
        partial(_perturbation, arrays),
        carry=partial(_carry, arrays),
        begin=partial(_begin, arrays, body),
        derive=partial(_derive, arrays),
        explore=partial(_explore, arrays),
        spaces=activity_spaces(activity, body),
    )
