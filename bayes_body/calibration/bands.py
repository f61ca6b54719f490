r"""Are ranks uniform? Simultaneous bands around an empirical distribution function (Säilynoja, Bürkner & Vehtari 2022).

Of n ranks among B equally likely bins, $R_k$ lie in the first k. With $R_k \sim \mathrm{Bin}(n, k / B)$,

$$\gamma = 2 \min_{k < B} \min\big(P(\mathrm{Bin} \le R_k),\, P(\mathrm{Bin} \ge R_k)\big)$$

is the smallest two-sided tail on the way. Its distribution under uniform ranks is simulated: a curve's p-value is the share of simulated curves that
stray as far, and the band of a level is where $\gamma$ is above the quantile of that level. Over m quantities each band has the level
$1 - \alpha / m$ (Bonferroni), so that all curves together lie inside with probability $1 - \alpha$ at least; Holm's procedure rejects one of them
if and only if a curve leaves its band.
"""

from functools import lru_cache
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from scipy.special import bdtr

# Curves under uniform ranks. A p-value below 0.05 / 100 still stands on twenty of them.
SIMULATED = 40_000
SEED = 214


class Bands(NamedTuple):
    """Around the curve of one quantity: at each k / B the expected share, and the lowest and highest share inside."""

    points: Float[np.ndarray, " point"]
    low: Float[np.ndarray, " point"]
    high: Float[np.ndarray, " point"]


def rank_counts(ranks: Int[np.ndarray, "replication quantity"], bins: int) -> Int[np.ndarray, "quantity bin"]:
    """How many ranks lie in each bin."""
    return np.stack([np.bincount(column, minlength=bins) for column in ranks.T])


def p_values(counts: Int[np.ndarray, "quantity bin"]) -> Float[np.ndarray, " quantity"]:
    """Of each quantity by itself, against uniform ranks."""
    null = _null(int(counts[0].sum()), counts.shape[1])
    # Ties among the simulated, which are whole numbers too, count against a rejection.
    return np.array([(np.sum(null <= own * (1 + 1e-9)) + 1) / (len(null) + 1) for own in _gamma(counts)])


def bands(replications: int, bins: int, level: float) -> Bands:
    """The band in which a curve lies from end to end with probability `level`."""
    from arviz_stats.ecdf_utils import get_pointwise_confidence_band

    points = np.arange(1, bins) / bins
    gamma = np.quantile(_null(replications, bins), 1 - level, method="inverted_cdf")
    low, high = get_pointwise_confidence_band(1 - gamma, replications, points)
    return Bands(points, low, high)


def family_level(quantities: int, family: float = 0.95) -> float:
    """The level of each of several bands, for all of them together to have the level `family`."""
    return 1 - (1 - family) / max(quantities, 1)


def holm(p: Float[np.ndarray, " test"], family: float = 0.95) -> Float[np.ndarray, " test"]:
    """Which of several tests reject (1.0) so that any false rejection has at most the probability 1 - `family` (Holm 1979)."""
    order, rejected = np.argsort(p), np.zeros(len(p))
    for place, index in enumerate(order):
        if p[index] > (1 - family) / (len(p) - place):
            break
        rejected[index] = 1.0
    return rejected


@lru_cache(maxsize=8)
def _null(replications: int, bins: int) -> Float[np.ndarray, " curve"]:
    rng = np.random.default_rng(SEED)
    return _gamma(rng.multinomial(replications, np.full(bins, 1 / bins), SIMULATED))


def _gamma(counts: Int[np.ndarray, "curve bin"]) -> Float[np.ndarray, " curve"]:
    total, bins = int(counts[0].sum()), counts.shape[1]
    below = np.cumsum(counts, axis=1)[:, :-1]
    points = np.arange(1, bins) / bins
    at_most = bdtr(below, total, points)
    # bdtr has no value below zero, where nothing lies.
    at_least = 1 - np.where(below > 0, bdtr(np.maximum(below - 1, 0), total, points), 0.0)
    return 2 * np.minimum(at_most, at_least).min(axis=1)
