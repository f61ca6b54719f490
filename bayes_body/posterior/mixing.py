"""How the Markov chains of a frame mixed: R-hat over them, effective draws and autocorrelation of each dof, divergences, energy.

A filter of Hamiltonian Monte Carlo runs several chains a frame, whose draws lie one chain after the other. These are not ArviZ's chains, which are
independent filters: chains of one frame share its prediction, and say whether they reached one posterior, not whether another filter would.
"""

from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from bayes_body.posterior.agreement import split_rhat
from bayes_body.posterior.blocks import BLOCK, pose_blocks

if TYPE_CHECKING:
    import xarray as xr

# In the tree's group `filter`.
PREFIX = "markov_"
# Draws of a chain from which on its halves can be told apart.
FEWEST = 4
# Of these lags an autocorrelation is shown, at most.
LAGS = 40


class Mixing(NamedTuple):
    """Figures of all chains.

    Attributes:
        length: draws of a chain.
        acceptance: mean probability of acceptance behind burn-in.
        divergences: trajectories behind burn-in whose energy went wrong.
        energy_fraction: E-BFMI (Betancourt 2016): how far a fresh momentum moves the energy, as a share of how far it varies.
        step: factor of the step size behind burn-in.
        ess: effective draws of all chains together, by autocorrelation.
        rhat: rank-normalised split R-hat over the chains; NaN below two chains or four draws of each.
    """

    length: int
    acceptance: Float[np.ndarray, "run frame chain"]
    divergences: Int[np.ndarray, "run frame chain"]
    energy_fraction: Float[np.ndarray, "run frame chain"]
    step: Float[np.ndarray, "run frame chain"]
    ess: Float[np.ndarray, "run frame dof"]
    rhat: Float[np.ndarray, "run frame dof"]


def mixing_of(tree: "xr.DataTree", block: int = BLOCK) -> Mixing | None:
    """The figures of a posterior's tree; None where its kernel runs no chains. At most `block` frames are read at a time."""
    group = tree["filter"]
    if f"{PREFIX}length" not in group:
        return None
    length = int(np.asarray(group[f"{PREFIX}length"]).max())
    acceptance, energy, step, ess = (np.asarray(group[PREFIX + name], float) for name in ("acceptance", "energy_fraction", "step", "ess"))
    rhat = np.concatenate([_rhat(by_chain(piece.poses, length)) for piece in pose_blocks(tree, block=block)], axis=1)
    return Mixing(length, acceptance, np.asarray(group[f"{PREFIX}divergences"], int), energy, step, ess, rhat)


def by_chain(poses: Float[np.ndarray, "run draw frame dof"], length: int) -> Float[np.ndarray, "run chain step frame dof"]:
    """Draws chain by chain; a last chain that is not whole is left out, or kept where it is the only one."""
    runs, draws, *rest = poses.shape
    chains = max(draws // length, 1)
    steps = min(length, draws)
    return poses[:, : chains * steps].reshape(runs, chains, steps, *rest)


def _rhat(draws: Float[np.ndarray, "run chain step frame dof"]) -> Float[np.ndarray, "run frame dof"]:
    runs, chains, steps, frames, dofs = draws.shape
    if chains < 2 or steps < FEWEST:
        return np.full((runs, frames, dofs), np.nan)
    together = draws.transpose(0, 3, 1, 2, 4).reshape(-1, chains, steps, dofs)
    return split_rhat(together).reshape(runs, frames, dofs)


def autocorrelation(draws: Float[np.ndarray, "chain step"]) -> Float[np.ndarray, " lag"]:
    """Of one dof, the mean over chains around the mean of all, from lag 0 on; NaN where the dof never moves."""
    centred = draws - draws.mean()
    steps = draws.shape[1]
    lags = min(LAGS, steps - 1) + 1
    products = np.array([np.sum(centred[:, : steps - lag] * centred[:, lag:]) / (steps - lag) for lag in range(lags)])
    return products / products[0] if products[0] > 0 else np.full(lags, np.nan)
