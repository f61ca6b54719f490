r"""How far the ranks of runs that agree may lie from even ones: c of $|F(z) - z| \le c \sqrt{z (1 - z)}$, for all runs and all z at once.

By simulation: of runs that agree, every order of the draws is as likely as any other. ArviZ's own region holds everything where there are two runs.
"""

from functools import cache

import numpy as np

from bayes_body.posterior.resampling import RESAMPLING_SEED

SIMULATIONS = 500


@cache
def rank_region(runs: int, draws: int, share: float = 0.95) -> float:
    """The constant c.

    Args:
        runs: how many.
        draws: of each.
        share: of agreeing sets of runs, those that stay inside.
    """
    rng = np.random.default_rng(RESAMPLING_SEED)
    even = np.arange(1, draws) / draws
    largest = np.empty(SIMULATIONS)
    for index in range(SIMULATIONS):
        ranks = np.sort(rng.permutation(runs * draws).reshape(runs, draws), axis=1) + 1
        counts = np.stack([np.searchsorted(of_run, even * runs * draws, side="right") for of_run in ranks])
        largest[index] = (np.abs(counts / draws - even) / np.sqrt(even * (1 - even))).max()
    return float(np.quantile(largest, share))
