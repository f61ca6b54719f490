"""What respects the weights: means, markers, equal-weight draws, R-hat.

Nothing in ArviZ takes weights, so what ArviZ computes (R-hat) is computed on equal-weight draws made from the particles by resampling.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from bayes_body.model import Model
from bayes_body.tracking import Draws

# Equal-weight draws are a matter of the posterior, not of the sampler: their seed is fixed, so that a saved run always gives the same figures.
RESAMPLING_SEED = 0


def mean_poses(draws: Draws) -> Float[np.ndarray, "run frame dof"]:
    """The weighted posterior mean of each run and frame, radians and metres."""
    weights = np.exp(draws.log_weights - draws.log_weights.max(axis=-1, keepdims=True))
    weights /= weights.sum(axis=-1, keepdims=True)
    return np.einsum("rfp,rfpd->rfd", weights, draws.states["pose"])


def markers(model: Model, poses: Float[np.ndarray, "*batch dof"]) -> Float[np.ndarray, "*batch marker 3"]:
    """The 15 virtual markers of any array of poses, metres, computed when asked for."""
    flat = jnp.asarray(poses.reshape(-1, poses.shape[-1]))
    positions = np.asarray(jax.jit(jax.vmap(model.markers))(flat))
    return positions.reshape(*poses.shape[:-1], *positions.shape[1:])


def equal_weight_draws(draws: Draws, count: int | None = None, seed: int = RESAMPLING_SEED) -> Float[np.ndarray, "run frame draw dof"]:
    """Draws of equal weight, by systematic resampling in random order; as many as there are particles, or `count`."""
    rng = np.random.default_rng(seed)
    runs, frames, particles = draws.log_weights.shape
    number = particles if count is None else count
    out = np.empty((runs, frames, number, draws.states["pose"].shape[-1]), draws.states["pose"].dtype)
    for run in range(runs):
        for frame in range(frames):
            log_weights = draws.log_weights[run, frame].astype(float)
            cumulative = np.cumsum(np.exp(log_weights - log_weights.max()))
            places = (np.arange(number) + rng.random()) / number * cumulative[-1]
            chosen = np.minimum(np.searchsorted(cumulative, places), particles - 1)
            out[run, frame] = draws.states["pose"][run, frame, rng.permutation(chosen)]
    return out


def rhat(draws: Draws) -> Float[np.ndarray, "frame dof"]:
    """Rank-normalised split R-hat over the runs (Vehtari et al. 2021); NaN with a single run. A dof that never moves has none either."""
    import arviz as az
    import xarray as xr

    sample = equal_weight_draws(draws)
    if sample.shape[0] < 2:
        return np.full(sample.shape[1:2] + sample.shape[-1:], np.nan)
    array = xr.DataArray(np.swapaxes(sample, 1, 2), dims=("chain", "draw", "frame", "dof"), name="pose")
    return np.asarray(az.rhat(array.to_dataset())["pose"])
