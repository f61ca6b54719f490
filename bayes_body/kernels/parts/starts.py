"""Where the chains of a frame begin: states that are drawn from the prediction and chosen by the likelihood.

A chain samples its target from any start, but it does not leave the mode that it began in: a mode without a start is not found.
"""

from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Int

from bayes_body.density.density import Unconstrained
from bayes_body.density.factor import Particles
from bayes_body.kernels import annealed_filter
from bayes_body.kernels.parts.resampling import Resample
from bayes_body.kernels.parts.weights import predict
from bayes_body.shapes import Flag, Key, Scalar

type StartsBy = Literal["importance", "annealing"]


class Start(NamedTuple):
    """Where a chain begins: coordinates without limits, and the ancestor that the state was predicted from."""

    position: dict[str, Array]
    ancestor: Int[Array, ""]


class Initialisation(NamedTuple):
    """The starts of all chains, and figures of the search for them.

    Attributes:
        starts: one a chain, along a leading axis.
        log_evidence: an estimate from draws of the prediction, nats.
        lost: no draw explained the image.
        evaluations: of the likelihood.
    """

    starts: Start
    log_evidence: Scalar
    lost: Flag
    evaluations: Any


def by_importance(key: Key, target: Unconstrained, count: int, chains: int, resample: Resample) -> Initialisation:
    """Sampling importance resampling of draws of the prediction mixture (Poon & Fleet 2002, 4).

    Where the likelihood is much narrower than the prediction only a few of the draws are chosen, each several times.

    Args:
        key: of all draws.
        target: the marginal view of the frame's density, after the particles of the frame before.
        count: draws of the prediction mixture.
        chains: starts.
        resample: a scheme.
    """
    ancestor_key, draw_key, resample_key = jax.random.split(key, 3)
    ancestors = resample(ancestor_key, target.density.previous.log_weights, count)
    drawn = predict(draw_key, ancestors, target.density)
    weights = drawn.normalised()
    chosen = resample(resample_key, weights.log_weights, chains)
    position = target.unconstrain(jax.tree.map(lambda leaf: leaf[chosen], drawn.states))
    return Initialisation(Start(position, ancestors[chosen]), drawn.log_evidence(), weights.lost, count)


def by_annealing(key: Key, target: Unconstrained, count: int, chains: int, resample: Resample) -> Initialisation:
    """Particles of the annealed filter (Deutscher & Reid 2005) after the same mixture; the starts are drawn from them by weight.

    Its layers weight by powers of the likelihood at which half of the particles survive. A mode that is worse by some tens of nats keeps a start, and
    an image or two later it may prove to be the right one. The annealed filter does not estimate the evidence: that comes from as many draws of the
    prediction.

    Args:
        key: of all draws.
        target: as of `by_importance`.
        count: particles.
        chains: starts.
        resample: a scheme.
    """
    importance_key, parent_key, anneal_key, choose_key = jax.random.split(key, 4)
    by_weight = by_importance(importance_key, target, count, chains, resample)
    previous = target.density.previous
    parents = resample(parent_key, previous.log_weights, count)
    equal = jnp.full((count,), -jnp.log(count), previous.log_weights.dtype)
    before = Particles(jax.tree.map(lambda leaf: leaf[parents], dict(previous.states)), equal)
    after, info = annealed_filter.build_kernel()(anneal_key, before, target.density)
    chosen = resample(choose_key, after.log_weights, chains)
    position = target.unconstrain(jax.tree.map(lambda leaf: leaf[chosen], dict(after.states)))
    starts = Start(position, parents[info.ancestors[chosen]])
    return by_weight._replace(starts=starts, lost=by_weight.lost | info.lost, evaluations=by_weight.evaluations + info.evaluations)
