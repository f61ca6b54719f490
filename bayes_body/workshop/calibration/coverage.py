"""The coverage of the posterior's weighted, equal-tailed intervals: how often they contain the truth. Each coverage has a binomial interval."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.stats import binomtest

WIDTHS = (0.5, 0.9)
CONFIDENCE = 0.95


class Coverage(NamedTuple):
    """The fraction of truths inside, and a binomial interval for its probability (Wilson 1927)."""

    share: float
    low: float
    high: float


def coverage(levels: Float[np.ndarray, " replication"], width: float) -> Coverage:
    """The coverage of one quantity.

    Args:
        levels: posterior probability below the truth, by replication.
        width: posterior probability of the interval, such as 0.9.
    """
    inside = int(np.sum(np.abs(levels - 0.5) <= width / 2))
    interval = binomtest(inside, len(levels)).proportion_ci(CONFIDENCE, method="wilson")
    return Coverage(inside / len(levels), float(interval.low), float(interval.high))
