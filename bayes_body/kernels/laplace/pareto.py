"""The tail of importance weights inside a compiled program: the shape k of `results/posterior/pareto.py`, for one set of weights."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from bayes_body.base.pareto import FEWEST_TAIL, PRIOR_DRAWS, PRIOR_QUARTILE, PRIOR_SHAPE, tail_size
from bayes_body.base.shapes import Scalar
from bayes_body.kernels.weights import LogWeights


def pareto_shape(log_weights: LogWeights) -> Scalar:
    """Return k; NaN if the largest weights are nearly equal, or with fewer than 25 draws; ∞ if a few draws have all the weight."""
    count = log_weights.shape[0]
    tail = tail_size(count)
    if tail < FEWEST_TAIL:
        return jnp.full((), jnp.nan, log_weights.dtype)
    largest = jnp.sort(log_weights)[-tail - 1 :]
    weights = jnp.exp(largest - largest[-1])
    above = weights[1:] - weights[0]
    quartile = above[int(tail / 4 + 0.5) - 1]
    is_flat, is_heaped = above[-1] <= np.finfo(np.float32).eps, quartile <= above[0]
    heaped = jnp.where(weights[0] < np.finfo(log_weights.dtype).tiny, jnp.inf, jnp.nan)
    return jnp.where(is_flat, jnp.nan, jnp.where(is_heaped, heaped, _fit(above, quartile)))


def _fit(above: Float[Array, " tail"], quartile: Scalar) -> Scalar:
    """Return k of ascending exceedances (Zhang & Stephens 2009)."""
    count = above.shape[0]
    points = 30 + int(count**0.5)
    grid = 1 - np.sqrt(points / (np.arange(1, points + 1) - 0.5))
    theta = jnp.asarray(grid, above.dtype) / (PRIOR_QUARTILE * quartile) + 1 / above[-1]
    shape = jnp.mean(jnp.log1p(-theta[:, None] * above), axis=1)
    log_likelihood = count * (jnp.log(-theta / shape) - shape - 1)
    likelihood = jnp.exp(log_likelihood - jnp.max(log_likelihood))
    k = jnp.mean(jnp.log1p(-jnp.sum(theta * likelihood) / jnp.sum(likelihood) * above))
    return (count * k + PRIOR_DRAWS * PRIOR_SHAPE) / (count + PRIOR_DRAWS)
