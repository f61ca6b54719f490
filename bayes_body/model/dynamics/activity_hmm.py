r"""A motion prior by a learned activity (Darby, Li & Costen 2008, 4 to 6): a hidden Markov model moves through a subspace of the joint angles.

Sampled are the features f, the residual r, and what is free: position $\tau$, orientation $\theta$ and the head. The pose is derived,

$$s = \mathrm{clip}(m + \bar\epsilon + \Phi f + r,\ \mathrm{low},\ \mathrm{high}),$$

with the mean pose m of a known subject, or the average of all. One learned file serves two readings; the kernel chooses.

**As a density**, which posterior samplers use. A particle carries the probabilities a of the hidden states, given its features so far:

$$p(f_t \mid a_{t-1}) = \sum_j (a_{t-1} A)_j\, N(f_t; \mu_j, \Sigma_j), \qquad a_{t,j} \propto (a_{t-1} A)_j\, N(f_t; \mu_j, \Sigma_j).$$

The residual, which the paper lacks, is an autoregressive process of first order with the standard deviation of what the features leave. For an
unknown subject, the spread of the subjects' mean poses is added. The free variables are a random walk; the position may keep a share of its step,
and less of its part across the direction in which the pelvis faces. The step before the first frame is unknown.

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
from numpyro.distributions import Categorical, Distribution, MixtureSameFamily, MultivariateNormal, Normal

from bayes_body.base.registry import register
from bayes_body.base.shapes import Key, Scalar
from bayes_body.density.factor import State, Transition
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
    derive_pose,
    log_emissions,
    transitions_needed,
)
from bayes_body.model.dynamics.activity_first import begin


def _carried_step(arrays: ActivityArrays, previous: State) -> Float[Array, "3"]:
    """Return what the position keeps of its last step: along the direction in which the pelvis faces, and across it."""
    step, yaw = previous[POSITION] - previous.get(BEFORE, previous[POSITION]), previous[ORIENTATION][0]
    aside = jnp.stack([-jnp.sin(yaw), jnp.cos(yaw), jnp.zeros_like(yaw)])
    return arrays.momentum * step - (arrays.momentum - arrays.momentum_aside) * jnp.dot(step, aside) * aside


def _conditional(arrays: ActivityArrays, previous: State) -> dict[str, Distribution]:
    belief = previous[BELIEF] @ arrays.transition
    emitted = MultivariateNormal(arrays.locations, scale_tril=arrays.factor)
    distributions: dict[str, Distribution] = {
        FEATURES: MixtureSameFamily(Categorical(probs=belief), emitted),
        POSITION: _normal(previous[POSITION] + _carried_step(arrays, previous), arrays.sd[POSITION]),
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
    return {**sampled, BELIEF: jax.nn.softmax(log_belief + log_emissions(arrays, sampled[FEATURES])), BEFORE: previous[POSITION]}


def _perturbation(arrays: ActivityArrays, state: State, scale: Scalar) -> dict[str, Distribution]:
    """Noise around a state: of the most likely hidden state for the features."""
    active = jnp.argmax(log_emissions(arrays, state[FEATURES]))
    feature_noise = MultivariateNormal(state[FEATURES], scale_tril=jnp.sqrt(scale) * arrays.factor[active])
    return {FEATURES: feature_noise, **{name: _normal(state[name], sd * scale) for name, sd in arrays.sd.items()}}


def _first(arrays: ActivityArrays, state: State) -> dict[str, Distribution]:
    """Return the distribution of the position before a first pose, which says nothing of the walker's speed."""
    return {BEFORE: _normal(state[POSITION], arrays.first_step)}


def _explore(arrays: ActivityArrays, key: Key, state: State, previous: State, scale: Scalar) -> dict[str, Array]:
    """Return sampled variables of the paper's proposal at one layer."""
    walk_key, emit_key, *keys = jax.random.split(key, 2 + len(arrays.sd))
    start = jnp.argmax(log_emissions(arrays, state[FEATURES]))
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
    moved[POSITION] += jnp.where(scale < 1, 0.0, _carried_step(arrays, previous))
    return {FEATURES: centre + jnp.sqrt(scale) * noise, **moved}


def _normal(centre: Array, sd: Array) -> Distribution:
    return Normal(centre, jnp.broadcast_to(sd, centre.shape)).to_event(1)


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
        begin=partial(begin, arrays, body),
        first=partial(_first, arrays) if options.momentum else None,
        derive=partial(derive_pose, arrays),
        explore=partial(_explore, arrays),
        spaces=activity_spaces(activity, body),
    )
