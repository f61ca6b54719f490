r"""The region for the ranks of runs that agree: c in $|F(z) - z| \le c \sqrt{z (1 - z)}$, simultaneously for all runs and all z.

The constant is found by simulation: if runs agree, all orders of the pooled draws are equally likely. ArviZ's own region is not used, because with
two runs it contains everything.
"""

from functools import cache

import numpy as np

from bayes_body.results.posterior.resampling import RESAMPLING_SEED

SIMULATIONS = 500


@cache
def rank_region(runs: int, draws: int, share: float = 0.95) -> float:
    """Return the constant c.

    Args:
        runs: number of runs.
        draws: number of draws of each run.
        share: probability that all runs stay inside the region if they agree.
    """
    rng = np.random.default_rng(RESAMPLING_SEED)
    even = np.arange(1, draws) / draws
    largest = np.empty(SIMULATIONS)
    for index in range(SIMULATIONS):
        ranks = np.sort(rng.permutation(runs * draws).reshape(runs, draws), axis=1) + 1
        counts = np.stack([np.searchsorted(of_run, even * runs * draws, side="right") for of_run in ranks])
        largest[index] = (np.abs(counts / draws - even) / np.sqrt(even * (1 - even))).max()
    return float(np.quantile(largest, share))
