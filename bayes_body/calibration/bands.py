r"""Test ranks for uniformity: simultaneous bands around an empirical distribution function (Säilynoja, Bürkner & Vehtari 2022).

Among n ranks in B equally likely bins, $R_k$ are in the first k bins. With $R_k \sim \mathrm{Bin}(n, k / B)$,

$$\gamma = 2 \min_{k < B} \min\big(P(\mathrm{Bin} \le R_k),\, P(\mathrm{Bin} \ge R_k)\big)$$

is the smallest two-sided tail probability along the curve. Its distribution under uniform ranks is simulated. A curve's p-value is the fraction of
simulated curves with a $\gamma$ that is no larger. The band of a level is where $\gamma$ is above the quantile of that level. For m quantities, each
band has the level $1 - \alpha / m$ (Bonferroni), so all curves together lie inside with probability at least $1 - \alpha$. Holm's procedure rejects a
quantity if and only if some curve leaves its band.
"""

from functools import lru_cache
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from scipy.special import bdtr

# Number of simulated curves. A p-value of 0.05 / 100 still rests on twenty of them.
SIMULATED = 40_000
SEED = 214


class Bands(NamedTuple):
    """The band around one quantity's curve: at each k / B the expected fraction of ranks, and the lowest and highest fraction inside the band."""

    points: Float[np.ndarray, " point"]
    low: Float[np.ndarray, " point"]
    high: Float[np.ndarray, " point"]


def rank_counts(ranks: Int[np.ndarray, "replication quantity"], bins: int) -> Int[np.ndarray, "quantity bin"]:
    """The number of ranks in each bin."""
    return np.stack([np.bincount(column, minlength=bins) for column in ranks.T])


def p_values(counts: Int[np.ndarray, "quantity bin"]) -> Float[np.ndarray, " quantity"]:
    """The p-value of each quantity by itself, for uniform ranks."""
    null = _null(int(counts[0].sum()), counts.shape[1])
    # The simulated values are discrete too; ties count against a rejection.
    return np.array([(np.sum(null <= gamma * (1 + 1e-9)) + 1) / (len(null) + 1) for gamma in _gamma(counts)])


def bands(replications: int, bins: int, level: float) -> Bands:
    """The band that contains a whole curve with probability `level`."""
    from arviz_stats.ecdf_utils import get_pointwise_confidence_band

    points = np.arange(1, bins) / bins
    gamma = np.quantile(_null(replications, bins), 1 - level, method="inverted_cdf")
    low, high = get_pointwise_confidence_band(1 - gamma, replications, points)
    return Bands(points, low, high)


def family_level(quantities: int, family: float = 0.95) -> float:
    """The level of each single band for which all bands together have the level `family`."""
    return 1 - (1 - family) / max(quantities, 1)


def holm(p: Float[np.ndarray, " test"], family: float = 0.95) -> Float[np.ndarray, " test"]:
    """Which of several tests reject (1.0), so that the probability of any false rejection is at most 1 - `family` (Holm 1979)."""
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
    # bdtr is not defined below zero, where the probability is 0.
    at_least = 1 - np.where(below > 0, bdtr(np.maximum(below - 1, 0), total, points), 0.0)
    return 2 * np.minimum(at_most, at_least).min(axis=1)
