r"""The log-evidence of some frames from independent runs, and the difference between two models, with Monte Carlo errors.

A particle filter estimates $Z = p(z_{1:t})$ without bias, and so does the mean of R runs. Its logarithm is the estimate here,

$$\log \hat Z = \log \frac{1}{R} \sum_r e^{L_r}.$$

For many particles the $L_r$ are normal with variance $s^2$ and mean $\log Z - s^2 / 2$ (Bérard, Del Moral & Doucet 2014). The mean of a log-normal
variable, estimated by $\bar L + s^2 / 2$, has the variance $s^2 / R + s^4 / (2 (R - 1))$ in the logarithm. This is the error here, with the s of the
runs and Student's t for its uncertainty. The jackknife and the bootstrap of few runs give too small an error: they only know the runs that exist,
and a larger one that would dominate the mean is most likely not among them (docs/decisions).
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

LEVEL = 0.95


class Estimate(NamedTuple):
    """The log-evidence of the frames up to each one, nats.

    Attributes:
        value: logarithm of the mean of the runs' estimates.
        error: its Monte Carlo error; NaN with a single run, infinite if a run has no evidence at all.
        sd: standard deviation of the log-evidence over the runs; likewise.
        runs: number of runs.
    """

    value: Float[np.ndarray, " frame"]
    error: Float[np.ndarray, " frame"]
    sd: Float[np.ndarray, " frame"]
    runs: int


class Difference(NamedTuple):
    """The difference of two log-evidences up to each frame, nats: value, Monte Carlo error, and the ends of its 95 % interval."""

    value: Float[np.ndarray, " frame"]
    error: Float[np.ndarray, " frame"]
    low: Float[np.ndarray, " frame"]
    high: Float[np.ndarray, " frame"]


def estimate(log_evidence: Float[np.ndarray, "run frame"]) -> Estimate:
    """Return the log-evidence up to each frame, from that of each frame given the frames before it, of independent runs."""
    totals, runs = np.cumsum(np.asarray(log_evidence, float), axis=1), len(log_evidence)
    value = np.logaddexp.reduce(totals, axis=0) - np.log(runs)
    if runs < 2:
        missing = np.full(value.shape, np.nan)
        return Estimate(value, missing, missing, runs)
    possible = np.isfinite(totals).all(axis=0)
    sd = np.where(possible, np.where(possible, totals, 0.0).std(axis=0, ddof=1), np.inf)
    return Estimate(value, np.sqrt(sd**2 / runs + sd**4 / (2 * (runs - 1))), sd, runs)


def difference(first: Estimate, second: Estimate) -> Difference:
    """Return the first log-evidence minus the second one. The interval is that of Student's t with the degrees of freedom of Welch (1947)."""
    from scipy.stats import t

    variances = np.stack([first.error**2, second.error**2])
    total = variances.sum(axis=0)
    if first.runs < 2 or second.runs < 2:
        value = first.value - second.value
        missing = np.full(value.shape, np.nan)
        return Difference(value, missing, missing, missing)
    finite = np.isfinite(total)
    # Where no run has any evidence, nothing is known of the difference.
    value = np.where(np.isfinite(first.value) & np.isfinite(second.value), _finite(first.value) - _finite(second.value), np.nan)
    squares = np.where(finite, variances, 0.0) ** 2 / np.array([[first.runs - 1], [second.runs - 1]])
    freedom = np.divide(np.where(finite, total, 0.0) ** 2, squares.sum(axis=0), out=np.full(total.shape, 1.0), where=squares.sum(axis=0) > 0)
    half = np.where(finite, t.ppf((1 + LEVEL) / 2, freedom) * np.sqrt(np.where(finite, total, 0.0)), np.inf)
    return Difference(value, np.sqrt(total), _finite(value) - half, _finite(value) + half)


def _finite(values: Float[np.ndarray, " frame"]) -> Float[np.ndarray, " frame"]:
    return np.where(np.isfinite(values), values, 0.0)
