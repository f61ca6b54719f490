"""Mixing of the Markov chains of a frame: R-hat, effective draws and autocorrelation of each dof, divergences, energy.

The Hamiltonian Monte Carlo filter runs several chains in each frame, and stores their draws one chain after the other. These are not the chains of
the ArviZ tree, which are independent runs of the filter. The chains of one frame share its prediction. Their R-hat tests whether they reached the
same posterior. It does not test whether another run of the filter would reach it too.
"""

from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from bayes_body.results.posterior.agreement import chain_rhat
from bayes_body.results.posterior.blocks import BLOCK, coordinate_blocks, stored_spaces
from bayes_body.results.posterior.thinning import MARKOV_RHAT, OF_ALL

if TYPE_CHECKING:
    import xarray as xr

# Prefix of the names in the tree's group `filter`.
PREFIX = "markov_"
# The largest lag of an autocorrelation that is shown.
LAGS = 40


class Mixing(NamedTuple):
    """The figures of all chains.

    Attributes:
        length: number of draws of a chain.
        acceptance: mean probability of acceptance after burn-in.
        divergences: number of divergent trajectories after burn-in.
        energy_fraction: E-BFMI (Betancourt 2016): the energy change by a fresh momentum, as a fraction of the energy's variation.
        step: factor of the step size after burn-in.
        ess: effective draws of all chains together, from their autocorrelation.
        rhat: rank-normalised split R-hat over the chains; NaN with fewer than two chains, or with fewer than four draws in each.
    """

    length: int
    acceptance: Float[np.ndarray, "run frame chain"]
    divergences: Int[np.ndarray, "run frame chain"]
    energy_fraction: Float[np.ndarray, "run frame chain"]
    step: Float[np.ndarray, "run frame chain"]
    ess: Float[np.ndarray, "run frame dof"]
    rhat: Float[np.ndarray, "run frame dof"]


def mixing_of(tree: "xr.DataTree", block: int = BLOCK) -> Mixing | None:
    """Return the figures of a posterior's tree; None if its kernel runs no Markov chains. At most `block` frames are read at a time."""
    group = tree["filter"]
    if f"{PREFIX}length" not in group:
        return None
    length = int(np.asarray(group[f"{PREFIX}length"]).max())
    acceptance, energy, step, ess = (np.asarray(group[PREFIX + name], float) for name in ("acceptance", "energy_fraction", "step", "ess"))
    rhat = thinned_figure(tree, MARKOV_RHAT)
    if rhat is None:
        rhat = np.concatenate([chain_rhat(piece.poses, length) for piece in coordinate_blocks(tree, block=block)], axis=1)
    return Mixing(length, acceptance, np.asarray(group[f"{PREFIX}divergences"], int), energy, step, ess, rhat)


def thinned_figure(tree: "xr.DataTree", figure: str) -> Float[np.ndarray, "*shape"] | None:
    """Return a figure of all particles of a thinned run, of all variables side by side; None if the run is not thinned or lacks it."""
    group = tree["filter"]
    names = [OF_ALL + figure + name for name in stored_spaces(tree)]
    return np.concatenate([np.asarray(group[name], float) for name in names], axis=-1) if all(name in group for name in names) else None


def autocorrelation(draws: Float[np.ndarray, "chain step"]) -> Float[np.ndarray, " lag"]:
    """Return the autocorrelation of one dof from lag 0 on, averaged over the chains; NaN for a dof that never moves.

    The draws are centred on the mean of all chains.
    """
    centred = draws - draws.mean()
    steps = draws.shape[1]
    lags = min(LAGS, steps - 1) + 1
    products = np.array([np.sum(centred[:, : steps - lag] * centred[:, lag:]) / (steps - lag) for lag in range(lags)])
    return products / products[0] if products[0] > 0 else np.full(lags, np.nan)
