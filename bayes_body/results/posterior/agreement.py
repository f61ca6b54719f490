r"""Agreement of independent runs: R-hat, and the number of independent draws to which a run is equivalent.

R-hat is the rank-normalised split R-hat of Vehtari et al. (2021): the larger of the bulk and the folded one. It does not use weights, so it is
computed on draws of equal weight. ArviZ gives the same figure for one dof of one frame at a time; `split_rhat` computes all dofs of many frames at
once.

The mean of n independent draws has the variance $\sigma^2 / n$. With $\sigma^2$ of the pooled posterior and the variance of the runs' means,
$n = \sigma^2 / \mathrm{Var}(\bar x_r)$. Unlike the effective sample size of the weights, n is also reduced by shared ancestors.
"""

import numpy as np
from jaxtyping import Float

from bayes_body.results.posterior.blocks import Block, weights_of_runs
from bayes_body.results.posterior.resampling import RESAMPLING_SEED, systematic_resampling

# R-hat splits each chain; a half needs two draws for a variance.
FEWEST_DRAWS = 4


def rhat_of_block(block: Block) -> Float[np.ndarray, "frame dof"]:
    """Return R-hat of every dof of each frame; NaN with a single run, with fewer than four draws, and for a dof that never moves."""
    runs, draws, frames, dofs = block.poses.shape
    if runs < 2 or draws < FEWEST_DRAWS:
        return np.full((frames, dofs), np.nan)
    return split_rhat(_equal_weight(block))


def split_rhat(draws: Float[np.ndarray, "frame chain draw dof"]) -> Float[np.ndarray, "frame dof"]:
    """Return the rank-normalised split R-hat of draws of equal weight, at least four per chain; NaN for a dof that never moves."""
    half = draws.shape[2] // 2
    split = np.concatenate([draws[:, :, :half], draws[:, :, -half:]], axis=1)
    folded = np.abs(split - np.median(split, axis=(1, 2), keepdims=True))
    return np.maximum(_rhat(_normal_scores(split)), _rhat(_normal_scores(folded)))


def _equal_weight(block: Block) -> Float[np.ndarray, "frame run draw dof"]:
    """Return draws of equal weight, as many as there are particles. Each frame has its own seed, so its draws do not depend on the block."""
    weights = weights_of_runs(block.log_weights)
    runs, draws, frames = weights.shape
    chosen = np.empty((frames, runs, draws), int)
    for place, frame in enumerate(block.frames):
        rng = np.random.default_rng([RESAMPLING_SEED, frame])
        for run in range(runs):
            chosen[place, run] = systematic_resampling(rng, weights[run, :, place], draws)
    return np.take_along_axis(block.poses.transpose(2, 0, 1, 3), chosen[..., None], axis=2)


def _normal_scores(values: Float[np.ndarray, "frame chain draw dof"]) -> Float[np.ndarray, "frame chain draw dof"]:
    """Return the normal scores of the ranks over all chains; equal values share the mean of their ranks."""
    from scipy.special import ndtri
    from scipy.stats import rankdata

    pooled = values.reshape(values.shape[0], -1, values.shape[-1])
    ranks = rankdata(pooled, axis=1)
    return ndtri((ranks - 3 / 8) / (pooled.shape[1] + 1 / 4)).reshape(values.shape)


def _rhat(scores: Float[np.ndarray, "frame chain draw dof"]) -> Float[np.ndarray, "frame dof"]:
    draws = scores.shape[2]
    within = scores.var(axis=2, ddof=1).mean(axis=1)
    between = scores.mean(axis=2).var(axis=1, ddof=1)
    moves = within > 0
    ratio = np.divide(between, within, out=np.full_like(within, np.nan), where=moves)
    return np.sqrt(ratio + (draws - 1) / draws)


def independent_draws(block: Block) -> Float[np.ndarray, " frame"]:
    """Return the number of independent draws to which a run is equivalent, over the dofs of each frame that move; NaN with a single run."""
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


def by_chain(poses: Float[np.ndarray, "run draw frame *shape"], length: int) -> Float[np.ndarray, "run chain step frame *shape"]:
    """Return the draws by chain; an incomplete last chain is dropped, unless it is the only one."""
    runs, draws, *trailing_shape = poses.shape
    chains = max(draws // length, 1)
    steps = min(length, draws)
    return poses[:, : chains * steps].reshape(runs, chains, steps, *trailing_shape)


def chain_rhat(poses: Float[np.ndarray, "run draw frame dof"], length: int) -> Float[np.ndarray, "run frame dof"]:
    """Return R-hat over the Markov chains of a frame, whose draws are stored one chain after the other."""
    draws = by_chain(poses, length)
    runs, chains, steps, frames, dofs = draws.shape
    if chains < 2 or steps < FEWEST_DRAWS:
        return np.full((runs, frames, dofs), np.nan)
    pooled = draws.transpose(0, 3, 1, 2, 4).reshape(-1, chains, steps, dofs)
    return split_rhat(pooled).reshape(runs, frames, dofs)
