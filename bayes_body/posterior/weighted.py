"""What respects the weights: means, markers, equal-weight draws, R-hat; of one frame, or of all.

Nothing in ArviZ takes weights, so what ArviZ computes (R-hat) is computed on equal-weight draws made from the particles by resampling.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from bayes_body.body.kinematics import marker_positions
from bayes_body.model.build import Model
from bayes_body.posterior.blocks import systematic_resampling
from bayes_body.tracking.draws import Draws, FrameResult

# Equal-weight draws are a matter of the posterior, not of the sampler: their seed is fixed, so that a saved run always gives the same figures.
RESAMPLING_SEED = 0

_positions = jax.jit(jax.vmap(marker_positions, (None, None, 0)))


def mean_pose(frame: FrameResult) -> Float[np.ndarray, "run dof"]:
    """The weighted posterior mean of each run, radians and metres."""
    weights = np.exp(frame.log_weights - frame.log_weights.max(axis=-1, keepdims=True))
    weights /= weights.sum(axis=-1, keepdims=True)
    return np.einsum("rp,rpd->rd", weights, frame.states["pose"])


def mean_poses(draws: Draws) -> Float[np.ndarray, "run frame dof"]:
    """The weighted posterior mean of each run and frame, radians and metres."""
    return np.stack([mean_pose(frame) for frame in draws.frames], axis=1)


def markers(model: Model, poses: Float[np.ndarray, "*batch dof"]) -> Float[np.ndarray, "*batch marker 3"]:
    """The virtual markers of any array of poses, metres, computed when asked for."""
    flat = jnp.asarray(poses.reshape(-1, poses.shape[-1]))
    positions = np.asarray(_positions(model.body.skeleton, model.body.markers, flat))
    return positions.reshape(*poses.shape[:-1], *positions.shape[1:])


def equal_weight_poses(frame: FrameResult, index: int, count: int | None = None, seed: int = RESAMPLING_SEED) -> Float[np.ndarray, "run draw dof"]:
    """One frame's poses of equal weight, by systematic resampling in random order.

    Args:
        frame: its particles.
        index: its number: each frame has random numbers of its own.
        count: how many; by default as many as there are particles.
        seed: of the resampling.
    """
    rng = np.random.default_rng((seed, index))
    runs, particles = frame.log_weights.shape
    number = particles if count is None else count
    out = np.empty((runs, number, frame.states["pose"].shape[-1]), frame.states["pose"].dtype)
    for run in range(runs):
        log_weights = frame.log_weights[run].astype(float)
        cumulative = np.cumsum(np.exp(log_weights - log_weights.max()))
        out[run] = frame.states["pose"][run, systematic_resampling(rng, cumulative, number)]
    return out


def equal_weight_draws(draws: Draws, count: int | None = None, seed: int = RESAMPLING_SEED) -> Float[np.ndarray, "run frame draw dof"]:
    """Poses of equal weight of all frames, in memory at once; as many as there are particles, or `count`."""
    return np.stack([equal_weight_poses(frame, index, count, seed) for index, frame in enumerate(draws.frames)], axis=1)


def frame_rhat(frame: FrameResult, index: int) -> Float[np.ndarray, " dof"]:
    """Rank-normalised split R-hat of one frame over the runs (Vehtari et al. 2021); NaN with a single run. A dof that never moves has none either.

    Args:
        frame: its particles.
        index: its number.
    """
    import arviz as az
    import xarray as xr

    if frame.log_weights.shape[0] < 2:
        return np.full(frame.states["pose"].shape[-1], np.nan)
    sample = equal_weight_poses(frame, index)
    # A dof that never moves is 0 / 0.
    with np.errstate(invalid="ignore"):
        return np.asarray(az.rhat(xr.Dataset({"pose": (("chain", "draw", "dof"), sample)}))["pose"])


def rhat(draws: Draws) -> Float[np.ndarray, "frame dof"]:
    """R-hat of all frames, as `frame_rhat`."""
    return np.stack([frame_rhat(frame, index) for index, frame in enumerate(draws.frames)])
