r"""Test ranks for uniformity: simultaneous bands around an empirical distribution function (Säilynoja, Bürkner & Vehtari 2022).

Among n ranks in B equally likely bins, $R_k$ are in the first k bins. With $R_k \sim \mathrm{Bin}(n, k / B)$,

$$\gamma = 2 \min_{k < B} \min\big(P(\mathrm{Bin} \le R_k),\, P(\mathrm{Bin} \ge R_k)\big)$$

is the smallest two-sided tail probability along the curve. The p-value is the probability that uniform ranks have a $\gamma$ that is no larger. It is
computed exactly: uniform ranks have a larger $\gamma$ if their curve stays inside the band of all $R_k$ whose tails are larger, and the counts of the
bins are independent Poisson numbers, given their sum. Simulation, as in ArviZ, cannot give the small p-values of many quantities and looks.
"""

from functools import lru_cache

import numpy as np
from jaxtyping import Float, Int
from scipy.stats import binom, poisson

# Tail probabilities that differ by less are equal up to rounding.
ROUNDING = 1e-9


def rank_counts(ranks: Int[np.ndarray, "replication quantity"], bins: int) -> Int[np.ndarray, "quantity bin"]:
    """The number of ranks in each bin."""
    return np.stack([np.bincount(column, minlength=bins) for column in ranks.T])


def p_values(counts: Int[np.ndarray, "quantity bin"]) -> Float[np.ndarray, " quantity"]:
    """The p-value of each quantity by itself, for uniform ranks."""
    total, bins = int(counts[0].sum()), counts.shape[1]
    least = _smaller_tails(total, bins)[np.cumsum(counts, axis=1)[:, :-1], np.arange(bins - 1)].min(axis=1)
    different, places = np.unique(least, return_inverse=True)
    return np.array([_p_value(tail, total, bins) for tail in different])[places]


def _p_value(least: float, total: int, bins: int) -> float:
    """The probability that uniform ranks have a smallest tail probability of at most `least`."""
    inside = _smaller_tails(total, bins) > least * (1 + ROUNDING)
    if not inside.any(axis=0).all():
        # No curve has larger tails in each bin.
        return 1.0
    low, high = inside.argmax(axis=0), total - inside[::-1].argmax(axis=0)
    # Not below the rounding errors of the sums.
    return float(np.clip(1 - _stays_inside(low, high, total), np.finfo(float).eps, 1.0))


@lru_cache(maxsize=8)
def _smaller_tails(total: int, bins: int) -> Float[np.ndarray, "count point"]:
    """The smaller of both tail probabilities of each number of ranks in the first k bins, for k from 1 to bins - 1."""
    count, points = np.arange(total + 1)[:, None], np.arange(1, bins) / bins
    return np.minimum(binom.cdf(count, total, points), binom.sf(count - 1, total, points))


def _stays_inside(low: Int[np.ndarray, " point"], high: Int[np.ndarray, " point"], total: int) -> float:
    """The probability that the curve of uniform ranks has between `low` and `high` of them in the first k bins, for every k."""
    one_bin = poisson.pmf(np.arange(total + 1), total / (len(low) + 1))
    chances, first = np.ones(1), 0
    for least, most in zip([*low, total], [*high, total], strict=True):
        chances = np.convolve(chances, one_bin[: most - first + 1])[least - first : most - first + 1]
        first = least
    return float(chances[0] / poisson.pmf(total, total))
