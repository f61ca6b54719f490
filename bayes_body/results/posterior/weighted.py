"""Weighted means, markers, draws of equal weight and R-hat, of one frame or of all frames.

R-hat does not use weights: it is computed on draws of equal weight, which are resampled from the particles.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from bayes_body.density.spaces import Space
from bayes_body.model.body.space import configuration_space
from bayes_body.model.body.world import placed_markers
from bayes_body.model.build import Model
from bayes_body.results.posterior.agreement import FEWEST_DRAWS, split_rhat
from bayes_body.results.posterior.blocks import around_mean
from bayes_body.results.posterior.resampling import RESAMPLING_SEED, systematic_resampling
from bayes_body.results.posterior.thinning import RHAT, weighted_mean
from bayes_body.tracking.draws import Draws, FrameResult

_positions = jax.jit(jax.vmap(placed_markers, (None, 0)))


def mean_pose(frame: FrameResult, model: Model) -> Float[np.ndarray, "run *shape"]:
    """Return the weighted posterior mean of each run, radians and metres: that of the variable that places the body, in its space."""
    return weighted_mean(frame, model.body.variable, configuration_space(model.body))


def mean_poses(draws: Draws) -> Float[np.ndarray, "run frame *shape"]:
    """Return the weighted posterior mean of each run and frame, radians and metres."""
    return np.stack([mean_pose(frame, draws.model) for frame in draws.frames], axis=1)


def markers(model: Model, poses: Float[np.ndarray, "*batch_and_shape"]) -> Float[np.ndarray, "*batch marker 3"]:
    """Return the positions of the virtual markers of an array of poses, or of values of another variable that places the body, metres."""
    shape = configuration_space(model.body).shape
    batch = poses.shape[: poses.ndim - len(shape)]
    positions = np.asarray(_positions(model.body, jnp.asarray(poses.reshape(-1, *shape))))
    return positions.reshape(*batch, *positions.shape[1:])


def equal_weight_poses(
    frame: FrameResult, index: int, count: int | None = None, seed: int = RESAMPLING_SEED, variable: str = "pose"
) -> Float[np.ndarray, "run draw *shape"]:
    """Return poses of equal weight from one frame's particles, by systematic resampling, in random order.

    Args:
        frame: the frame's particles.
        index: the frame's number, which gives each frame its own random numbers.
        count: number of draws; by default the number of particles.
        seed: seed of the resampling.
        variable: another variable of the state that is drawn instead of poses.
    """
    rng = np.random.default_rng((seed, index))
    runs, particles = frame.log_weights.shape
    number = particles if count is None else count
    values = frame.states[variable]
    out = np.empty((runs, number, *values.shape[2:]), values.dtype)
    for run in range(runs):
        log_weights = frame.log_weights[run].astype(float)
        out[run] = values[run, systematic_resampling(rng, np.exp(log_weights - log_weights.max()), number)]
    return out


def equal_weight_draws(draws: Draws, count: int | None = None, seed: int = RESAMPLING_SEED) -> Float[np.ndarray, "run frame draw *shape"]:
    """Return poses of equal weight of all frames, in memory at once; in each frame `count`, or by default as many as there are particles.

    Of a body that is placed by its parts, they are values of that variable.
    """
    variable = draws.model.body.variable
    return np.stack([equal_weight_poses(frame, index, count, seed, variable) for index, frame in enumerate(draws.frames)], axis=1)


def frame_rhat(frame: FrameResult, index: int, variable: str, space: Space) -> Float[np.ndarray, " dimension"]:
    """Return R-hat of one frame over the runs (`agreement.split_rhat`), in the coordinates of a variable's space around the mean of all runs.

    It is NaN with a single run, with fewer than four particles, and for a dof that never moves.

    Args:
        frame: the frame's particles.
        index: the frame's number.
        variable: the variable, such as `pose`.
        space: where it lives.
    """
    if RHAT + variable in frame.figures:
        return frame.figures[RHAT + variable]
    runs, draws = frame.log_weights.shape
    if runs < 2 or draws < FEWEST_DRAWS:
        return np.full(space.dimension, np.nan)
    equal = equal_weight_poses(frame, index, variable=variable)[:, :, None]
    return split_rhat(around_mean(space, equal, np.zeros(equal.shape[:3])).transpose(2, 0, 1, 3))[0]


def rhat(draws: Draws) -> Float[np.ndarray, "frame dimension"]:
    """Return R-hat of all frames, as `frame_rhat`, of the variable that places the body."""
    variable, space = draws.model.body.variable, configuration_space(draws.model.body)
    return np.stack([frame_rhat(frame, index, variable, space) for index, frame in enumerate(draws.frames)])
