r"""Whether independent runs agree: R-hat, and how many independent draws a run is worth.

R-hat is the rank-normalised split R-hat of Vehtari et al. (2021), the larger of bulk and folded, on equal-weight draws: nothing in it knows weights.
ArviZ computes it one dof of one frame at a time; this computes many at once.

A run of n independent draws has a mean of variance $\sigma^2 / n$. With the variance of the runs' means against that of the pooled posterior,
$n = \sigma^2 / \mathrm{Var}(\bar x_r)$: what a weight's effective sample size leaves out, that particles share ancestors, is in it.
"""

import numpy as np
from jaxtyping import Float

from bayes_body.posterior.blocks import Block, systematic_resampling, weights_of_runs
from bayes_body.posterior.weighted import RESAMPLING_SEED


def rhat_of_block(block: Block) -> Float[np.ndarray, "frame dof"]:
    """R-hat of every dof of each frame; NaN with a single run, below four draws, or where a dof never moves."""
    runs, draws, frames, dofs = block.poses.shape
    if runs < 2 or draws < 4:
        return np.full((frames, dofs), np.nan)
    return split_rhat(_equal_weight(block))


def split_rhat(draws: Float[np.ndarray, "frame chain draw dof"]) -> Float[np.ndarray, "frame dof"]:
    """Rank-normalised split R-hat of draws of equal weight, four of a chain or more; NaN where a dof never moves."""
    half = draws.shape[2] // 2
    split = np.concatenate([draws[:, :, :half], draws[:, :, -half:]], axis=1)
    folded = np.abs(split - np.median(split, axis=(1, 2), keepdims=True))
    return np.maximum(_rhat(_normal_scores(split)), _rhat(_normal_scores(folded)))


def _equal_weight(block: Block) -> Float[np.ndarray, "frame run draw dof"]:
    """As many equal-weight draws as there are particles, by systematic resampling in random order; a frame's own seed, whatever the block."""
    cumulative = np.cumsum(weights_of_runs(block.log_weights), axis=1)
    runs, draws, frames = cumulative.shape
    chosen = np.empty((frames, runs, draws), int)
    for place, frame in enumerate(block.frames):
        rng = np.random.default_rng([RESAMPLING_SEED, frame])
        for run in range(runs):
            chosen[place, run] = systematic_resampling(rng, cumulative[run, :, place], draws)
    return np.take_along_axis(block.poses.transpose(2, 0, 1, 3), chosen[..., None], axis=2)


def _normal_scores(values: Float[np.ndarray, "frame chain draw dof"]) -> Float[np.ndarray, "frame chain draw dof"]:
    """The normal quantiles of the ranks over all chains, equal values sharing the mean of their ranks."""
    from scipy.special import ndtri
    from scipy.stats import rankdata

    together = values.reshape(values.shape[0], -1, values.shape[-1])
    ranks = rankdata(together, axis=1)
    return ndtri((ranks - 3 / 8) / (together.shape[1] + 1 / 4)).reshape(values.shape)


def _rhat(scores: Float[np.ndarray, "frame chain draw dof"]) -> Float[np.ndarray, "frame dof"]:
    draws = scores.shape[2]
    within = scores.var(axis=2, ddof=1).mean(axis=1)
    between = scores.mean(axis=2).var(axis=1, ddof=1)
    moves = within > 0
    ratio = np.divide(between, within, out=np.full_like(within, np.nan), where=moves)
    return np.sqrt(ratio + (draws - 1) / draws)


def independent_draws(block: Block) -> Float[np.ndarray, " frame"]:
    """How many independent draws a run is worth, over the dofs of each frame that move; NaN with a single run."""
    runs, _, frames, _ = block.poses.shape
    if runs < 2:
        return np.full(frames, np.nan)
    weights = weights_of_runs(block.log_weights)
    means = np.einsum("rsf,rsfd->rfd", weights, block.poses)
    within = np.einsum("rsf,rsfd->rfd", weights, (block.poses - means[:, None]) ** 2).mean(axis=0)
    spread = within + means.var(axis=0)
    moves = spread > 0
    share = np.divide(means.var(axis=0, ddof=1), spread, out=np.zeros_like(spread), where=moves).sum(axis=1)
    number = moves.sum(axis=1)
    return np.divide(number, share, out=np.full(frames, np.nan), where=share > 0)
