"""Where the chains of a frame begin: states that are chosen from the prediction by what the image says of them.

A chain keeps its target from wherever it begins, but it does not leave the mode that it began in: what is not among the starts is not found.
"""

from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Int

from bayes_body.density.factor import Particles, State
from bayes_body.kernels import annealed_filter
from bayes_body.kernels.parts.batching import over_particles
from bayes_body.kernels.parts.resampling import Resample
from bayes_body.kernels.parts.weights import normalise
from bayes_body.shapes import Key, Scalar

type StartsBy = Literal["importance", "annealing"]


class Start(NamedTuple):
    """Where a chain begins: coordinates without limits, and the ancestor that it was predicted from."""

    position: dict[str, Array]
    ancestor: Int[Array, ""]


class Started(NamedTuple):
    """The starts, with a leading chain axis, and what was learned on the way.

    Attributes:
        starts: one a chain.
        log_evidence: an estimate from draws of the prediction, nats.
        lost: nothing explained the image.
        evaluations: of the likelihood.
    """

    starts: Start
    log_evidence: Scalar
    lost: Array
    evaluations: Any


def by_importance(key: Key, target: Any, count: int, chains: int, resample: Resample) -> Started:
    """Sampling importance resampling of so many draws of the prediction mixture (Poon & Fleet 2002, 4).

    Where the image tells far more than the prediction only a few of the draws are chosen, each several times.

    Args:
        key: of all draws.
        target: the marginal view of the frame's density, after the particles of the frame before.
        count: draws of the prediction mixture.
        chains: starts.
        resample: a scheme.
    """
    ancestor_key, draw_key, resample_key = jax.random.split(key, 3)
    ancestors = resample(ancestor_key, target.density.previous.log_weights, count)
    keys = jax.random.split(draw_key, ancestors.shape[0])
    drawn, log_likelihoods, log_constraints = over_particles(_predicted, (keys, ancestors), target)
    weights = normalise(log_likelihoods + log_constraints)
    chosen = resample(resample_key, weights.log_weights, chains)
    position = target.unconstrain(jax.tree.map(lambda leaf: leaf[chosen], drawn))
    log_evidence = weights.log_sum - normalise(log_constraints).log_sum
    return Started(Start(position, ancestors[chosen]), log_evidence, weights.lost, count)


def by_annealing(key: Key, target: Any, count: int, chains: int, resample: Resample) -> Started:
    """So many particles of the annealed filter (Deutscher & Reid 2005) after the same mixture, and starts drawn of them by weight.

    Its layers weigh by powers of the likelihood that leave half of the particles: modes that are worse by some tens of nats keep a start, which an
    image or two later may prove to be the right one. The evidence is that of as many draws of the prediction: the annealed filter tells none.

    Args:
        key: of all draws.
        target: as of `by_importance`.
        count: particles.
        chains: starts.
        resample: a scheme.
    """
    weigh_key, parent_key, anneal_key, choose_key = jax.random.split(key, 4)
    weighed = by_importance(weigh_key, target, count, chains, resample)
    previous = target.density.previous
    parents = resample(parent_key, previous.log_weights, count)
    equal = jnp.full((count,), -jnp.log(count), previous.log_weights.dtype)
    before = Particles(jax.tree.map(lambda leaf: leaf[parents], dict(previous.states)), equal)
    after, info = annealed_filter.build_kernel()(anneal_key, before, target.density)
    chosen = resample(choose_key, after.log_weights, chains)
    position = target.unconstrain({name: after.states[name][chosen] for name in target.bijections})
    starts = Start(position, parents[info.ancestors[chosen]])
    return weighed._replace(starts=starts, lost=weighed.lost | info.lost, evaluations=weighed.evaluations + info.evaluations)


def _predicted(own: tuple[Key, Array], target: Any) -> tuple[State, Scalar, Scalar]:
    (key, ancestor), density = own, target.density
    previous = density.ancestor(ancestor)
    # Without the barrier XLA draws the noise anew wherever the state is read.
    state = jax.lax.optimization_barrier(density.transition.sample(key, previous))
    sampled = {name: state[name] for name in target.bijections}
    return sampled, density.log_likelihood(state, previous), density.log_constraint(state, previous)
