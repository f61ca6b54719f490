"""Weighted means, markers, draws of equal weight and R-hat, of one frame or of all frames.

R-hat does not use weights: it is computed on draws of equal weight, which are resampled from the particles.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from bayes_body.body.kinematics import marker_positions
from bayes_body.model.build import Model
from bayes_body.posterior.agreement import FEWEST_DRAWS, split_rhat
from bayes_body.posterior.resampling import RESAMPLING_SEED, systematic_resampling
from bayes_body.tracking.draws import Draws, FrameResult

_positions = jax.jit(jax.vmap(marker_positions, (None, None, 0)))


def mean_pose(frame: FrameResult) -> Float[np.ndarray, "run dof"]:
    """Return the weighted posterior mean of each run, radians and metres."""
    weights = np.exp(frame.log_weights - frame.log_weights.max(axis=-1, keepdims=True))
    weights /= weights.sum(axis=-1, keepdims=True)
    return np.einsum("rp,rpd->rd", weights, frame.states["pose"])


def mean_poses(draws: Draws) -> Float[np.ndarray, "run frame dof"]:
    """Return the weighted posterior mean of each run and frame, radians and metres."""
    return np.stack([mean_pose(frame) for frame in draws.frames], axis=1)


def markers(model: Model, poses: Float[np.ndarray, "*batch dof"]) -> Float[np.ndarray, "*batch marker 3"]:
    """Return the positions of the virtual markers of an array of poses, metres."""
    flat = jnp.asarray(poses.reshape(-1, poses.shape[-1]))
    positions = np.asarray(_positions(model.body.skeleton, model.body.markers, flat))
    return positions.reshape(*poses.shape[:-1], *positions.shape[1:])


def equal_weight_poses(frame: FrameResult, index: int, count: int | None = None, seed: int = RESAMPLING_SEED) -> Float[np.ndarray, "run draw dof"]:
    """Return poses of equal weight from one frame's particles, by systematic resampling, in random order.

    Args:
        frame: the frame's particles.
        index: the frame's number, which gives each frame its own random numbers.
        count: number of draws; by default the number of particles.
        seed: seed of the resampling.
    """
    rng = np.random.default_rng((seed, index))
    runs, particles = frame.log_weights.shape
    number = particles if count is None else count
    out = np.empty((runs, number, frame.states["pose"].shape[-1]), frame.states["pose"].dtype)
    for run in range(runs):
        log_weights = frame.log_weights[run].astype(float)
        out[run] = frame.states["pose"][run, systematic_resampling(rng, np.exp(log_weights - log_weights.max()), number)]
    return out


def equal_weight_draws(draws: Draws, count: int | None = None, seed: int = RESAMPLING_SEED) -> Float[np.ndarray, "run frame draw dof"]:
    """Return poses of equal weight of all frames, in memory at once; in each frame `count`, or by default as many as there are particles."""
    return np.stack([equal_weight_poses(frame, index, count, seed) for index, frame in enumerate(draws.frames)], axis=1)


def frame_rhat(frame: FrameResult, index: int) -> Float[np.ndarray, " dof"]:
    """Return R-hat of one frame over the runs (`agreement.split_rhat`).

    It is NaN with a single run, with fewer than four particles, and for a dof that never moves.

    Args:
        frame: the frame's particles.
        index: the frame's number.
    """
    runs, draws = frame.log_weights.shape
    if runs < 2 or draws < FEWEST_DRAWS:
        return np.full(frame.states["pose"].shape[-1], np.nan)
    return split_rhat(equal_weight_poses(frame, index)[None])[0]


def rhat(draws: Draws) -> Float[np.ndarray, "frame dof"]:
    """Return R-hat of all frames, as `frame_rhat`."""
    return np.stack([frame_rhat(frame, index) for index, frame in enumerate(draws.frames)])
