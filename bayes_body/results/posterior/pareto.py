r"""The tail of importance weights (Vehtari et al. 2024, PSIS): the shape k of a generalised Pareto distribution fitted to the largest weights.

The weights have a finite variance if $k < 1/2$, and a finite mean if $k < 1$. Above 0.7, estimates from them need impractically many draws. The fit
is the empirical Bayes estimate of Zhang & Stephens (2009), with the prior of Vehtari et al., which pulls k towards 0.5 with the weight of ten draws.
ArviZ fits one set of weights at a time; this module fits many at once.
"""

import numpy as np
from jaxtyping import Float

from bayes_body.base.pareto import FEWEST_TAIL, PRIOR_DRAWS, PRIOR_QUARTILE, PRIOR_SHAPE, tail_size


def pareto_shape(log_weights: Float[np.ndarray, "*batch draw"]) -> Float[np.ndarray, "*batch"]:
    """Return k of each set of weights; -∞ if the tail's weights are all equal, ∞ if a few draws have all the weight, NaN with fewer than 25 draws."""
    batch, draws = log_weights.shape[:-1], log_weights.shape[-1]
    tail = tail_size(draws)
    shapes = np.full(int(np.prod(batch)), np.nan)
    if tail < FEWEST_TAIL:
        return shapes.reshape(batch)
    flat = log_weights.reshape(-1, draws).astype(float)
    largest = np.sort(np.partition(flat, draws - tail - 1, axis=1)[:, -tail - 1 :], axis=1)
    weights = np.exp(largest - largest[:, -1:])
    above = weights[:, 1:] - weights[:, :1]
    quartile = above[:, int(tail / 4 + 0.5) - 1]
    flat_tail = above[:, -1] <= np.finfo(np.float32).eps
    # At least a quarter of the tail equals its smallest value. If these weights are zero, a few draws have all the weight.
    heaped = ~flat_tail & (quartile <= above[:, 0])
    shapes[flat_tail] = -np.inf
    shapes[heaped] = np.where(weights[heaped, 0] < np.finfo(float).tiny, np.inf, np.nan)
    fitted = ~flat_tail & ~heaped
    shapes[fitted] = _fit(above[fitted], quartile[fitted, None])
    return shapes.reshape(batch)


def _fit(above: Float[np.ndarray, "set tail"], quartile: Float[np.ndarray, "set 1"]) -> Float[np.ndarray, " set"]:
    """Return k of ascending exceedances: the mean of θ under its likelihood on a grid, then the k that belongs to it."""
    count = above.shape[1]
    points = 30 + int(count**0.5)
    grid = 1 - np.sqrt(points / (np.arange(1, points + 1) - 0.5))
    theta = grid / (PRIOR_QUARTILE * quartile) + 1 / above[:, -1:]
    shape = np.stack([np.log1p(-column[:, None] * above).mean(axis=1) for column in theta.T], axis=1)
    log_likelihood = count * (np.log(-theta / shape) - shape - 1)
    likelihood = np.exp(log_likelihood - log_likelihood.max(axis=1, keepdims=True))
    mean = (theta * likelihood).sum(axis=1) / likelihood.sum(axis=1)
    k = np.log1p(-mean[:, None] * above).mean(axis=1)
    return (count * k + PRIOR_DRAWS * PRIOR_SHAPE) / (count + PRIOR_DRAWS)
