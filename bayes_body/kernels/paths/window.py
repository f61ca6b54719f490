r"""Trajectories of a window of frames with error bars, from a gradient-based sampler in whitened coordinates.

Chains of NUTS sample the joint posterior of the window (density/trajectory.py). They start from smoothed paths, and move in coordinates in which
these paths are white.

A motion prior couples neighbouring frames strongly. If it is a random walk of small steps, the window can move as a whole, but one frame alone hardly
can. A sampler with a diagonal metric would take as many leapfrog steps as the ratio of these widths. The paths are therefore modelled as a Gaussian
process with the transition's memory $m$: each frame is a regression on the $m$ frames before,

$$x_t = \mu_t + \sum_{k=1}^{m} A_{tk} (x_{t-k} - \mu_{t-k}) + \epsilon_t, \qquad P = J^\top \mathrm{diag}(S_t^{-1})\, J,$$

with the residuals' covariances $S_t$ and the rows $J_t = (-A_{tm}, \dots, -A_{t1}, 1)$. This is the maximum likelihood estimate under this structure.
It needs a few more paths than $m$ frames have dofs; a covariance of the whole window would need more paths than the window has dofs. The precision of
a window given the rest of its path is a block of $P$. With $P = C C^\top$, a standard normal $z$ gives $\mu + C^{-\top} z$.
"""

from functools import partial
from typing import Annotated, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool, Float, Int
from pydantic import Field

from bayes_body.base.errors import input_error
from bayes_body.base.shapes import Key, Scalar
from bayes_body.base.toml.read import validate
from bayes_body.base.toml.schema import Count, Schema
from bayes_body.density.factor import State
from bayes_body.density.trajectory import Trajectory
from bayes_body.kernels.batching import over_particles
from bayes_body.kernels.paths.window_nuts import Metric, NutsSchedule, chain_diagnostics, run_nuts

# With fewer paths than this for each predictor, a frame is modelled as the frame before plus a step.
PATHS_PER_PREDICTOR = 2
# The share by which a residual's covariance is shrunk towards its diagonal, as in kernels/smc/moves.py.
SHRUNK = 0.1
# Added to a residual's variances: about the rounding of a coordinate of some metres.
LEAST_VARIANCE = 1e-12


class Whitening(NamedTuple):
    """Whitened coordinates of a window: position = centre + root z, over the coordinates of all frames, the first frame first."""

    centre: Float[Array, " entry"]
    root: Float[Array, "entry entry"]


class GaussianPath(NamedTuple):
    """The Gaussian process fitted to paths."""

    mean: Float[np.ndarray, "frame dof"]
    precision: Float[np.ndarray, "entry entry"]

    def whitening(self, begin: int = 0, count: int | None = None) -> Whitening:
        """Return the whitened coordinates of `count` frames from number `begin` on, given the other frames."""
        frames, dofs = self.mean.shape
        end = frames if count is None else begin + count
        window = slice(begin * dofs, end * dofs)
        factor = np.linalg.cholesky(self.precision[window, window])
        root = np.linalg.solve(factor.T, np.eye(len(factor)))
        return Whitening(jnp.asarray(self.mean[begin:end].ravel(), float), jnp.asarray(root, float))


def gaussian_path(values: Float[np.ndarray, "path frame dof"], memory: int) -> GaussianPath:
    """Return the Gaussian process fitted to paths.

    Args:
        values: coordinates of the paths.
        memory: number of previous frames on which a frame depends.
    """
    values = np.asarray(values, np.float64)
    paths, frames, dofs = values.shape
    mean = values.mean(axis=0)
    centred, precision = values - mean, np.zeros((frames * dofs,) * 2)
    for frame in range(frames):
        first = max(frame - memory, 0)
        history = centred[:, first:frame].reshape(paths, -1)
        weights, estimated = _regression(history, centred[:, frame])
        residual = _covariance(centred[:, frame] - history @ weights, paths - 1 - estimated)
        row = np.concatenate([-weights.T, np.eye(dofs)], axis=1)
        part = slice(first * dofs, (frame + 1) * dofs)
        precision[part, part] += row.T @ np.linalg.solve(residual, row)
    return GaussianPath(mean, precision)


def _regression(
    history: Float[np.ndarray, "path predictor"], current: Float[np.ndarray, "path dof"]
) -> tuple[Float[np.ndarray, "predictor dof"], int]:
    """Return the weights of the predictors, and how many of them were estimated."""
    (paths, predictors), dofs = history.shape, current.shape[1]
    if paths > PATHS_PER_PREDICTOR * predictors:
        return np.linalg.lstsq(history, current, rcond=None)[0], predictors
    return np.concatenate([np.zeros((predictors - dofs, dofs)), np.eye(dofs)]), 0


def _covariance(residuals: Float[np.ndarray, "path dof"], freedom: int) -> Float[np.ndarray, "dof dof"]:
    covariance = residuals.T @ residuals / max(freedom, 1)
    variances = np.diagonal(covariance)
    # No share of the largest variance: what hardly moves, such as an unknown camera, has a ten-millionth of a velocity's.
    return (1 - SHRUNK) * covariance + np.diag(SHRUNK * variances + LEAST_VARIANCE)


class Options(Schema):
    """Options of `sample_window`.

    `warm_up` and `draws` are transitions of each of the `chains`. Warm-up estimates the `metric` in whitened coordinates, and tunes the step to
    `target_acceptance`.
    """

    chains: Annotated[int, Field(strict=True, ge=2)] = 4
    warm_up: Count = 300
    draws: Count = 500
    metric: Metric = "diagonal"
    target_acceptance: Annotated[float, Field(gt=0, lt=1)] = 0.9


class WindowDraws(NamedTuple):
    """Trajectories of a window, and how well the chains agree.

    Attributes:
        states: whole states (chain, draw, frame, ...).
        coordinates: the unconstrained coordinates of the same.
        r_hat: rank-normalised split R-hat of each unconstrained coordinate.
        effective: bulk effective sample size of each coordinate, for all chains together.
        divergent: whether each trajectory after warm-up diverged.
        leapfrog_steps: number of leapfrog steps of each trajectory.
        acceptance: acceptance rate of each trajectory.
        log_density: at each draw, up to the evidence.
        step_size: step size of each chain after warm-up, in whitened coordinates.
        warm_up_steps: number of leapfrog steps of all chains in warm-up.
    """

    states: State
    coordinates: Float[Array, "chain draw frame dof"]
    r_hat: Float[Array, "frame dof"]
    effective: Float[Array, "frame dof"]
    divergent: Bool[Array, "chain draw"]
    leapfrog_steps: Int[Array, "chain draw"]
    acceptance: Float[Array, "chain draw"]
    log_density: Float[Array, "chain draw"]
    step_size: Float[Array, " chain"]
    warm_up_steps: Int[Array, ""]


def sample_window(key: Key, target: Trajectory, paths: State, whitening: Whitening | None = None, **options: int | float | str) -> WindowDraws:
    """Draw trajectories by NUTS.

    Args:
        key: random key.
        target: the joint density of the window.
        paths: whole states of smoothed paths through the window (path, frame, ...). Each chain starts from a different path.
        whitening: coordinates for the chains; by default those fitted to the paths.
        options: those of `Options`.

    Raises:
        InputError: an option is out of its range, or there are fewer paths than chains.
    """
    settings = validate(Options, options, "sample_window()")
    count = len(jax.tree.leaves(dict(paths))[0])
    if count < settings.chains:
        raise input_error("the paths", str(count), f"one for each of the {settings.chains} chains", "give more paths or run fewer chains")
    start_key, run_key = jax.random.split(key)
    chosen = jax.random.choice(start_key, count, (settings.chains,), replace=False)
    if whitening is None:
        whitening = fitted_path(target, paths).whitening()
    schedule = NutsSchedule(settings.warm_up, settings.draws, settings.metric, settings.target_acceptance)
    return _sampled(run_key, target, jax.tree.map(lambda leaf: jnp.asarray(leaf)[chosen], dict(paths)), whitening, schedule)


def fitted_path(target: Trajectory, paths: State) -> GaussianPath:
    """Return the Gaussian process of smoothed paths (path, frame, ...), in the window's unconstrained coordinates."""
    coordinates = jax.jit(jax.vmap(lambda path: flat(target.position(path))))(dict(paths))
    memory = target.frames.transition.frames_read
    return gaussian_path(np.asarray(coordinates), coordinates.shape[1] if memory is None else memory)


@partial(jax.jit, static_argnames="schedule")
def _sampled(key: Key, target: Trajectory, starts: State, whitening: Whitening, schedule: NutsSchedule) -> WindowDraws:
    run_key, complete_key = jax.random.split(key)
    positions = jax.vmap(target.position)(starts)
    form = jax.tree.map(lambda leaf: leaf[0], positions)
    white = jax.vmap(lambda position: whitened(position, whitening))(positions)
    chains = run_nuts(run_key, white, _log_density, (target, whitening, form), schedule)

    def complete(item: tuple[Key, Array], shared: tuple[Trajectory, Whitening, State]) -> tuple[State, Array]:
        position = position_at(item[1], *shared[1:])
        return shared[0].complete(item[0], position)[0], flat(position)

    every = chains.draws.reshape(-1, chains.draws.shape[-1])
    keys = jax.random.split(complete_key, len(every))
    completed = over_particles(complete, (keys, every), (target, whitening, form))
    states, coordinates = jax.tree.map(lambda leaf: leaf.reshape(*chains.draws.shape[:2], *leaf.shape[1:]), completed)
    r_hat, effective = chain_diagnostics(coordinates)
    by_draw = chains.divergent, chains.steps, chains.acceptance, chains.log_density
    return WindowDraws(states, coordinates, r_hat, effective, *by_draw, chains.step_size, jnp.sum(chains.warm_up_steps))


def _log_density(shared: tuple[Trajectory, Whitening, State], white: Float[Array, " entry"]) -> Scalar:
    target, whitening, form = shared
    return target(position_at(white, whitening, form))


def flat(position: State) -> Float[Array, "frame dof"]:
    """Return a position as one vector for each frame."""
    return jax.vmap(lambda frame: ravel_pytree(frame)[0])(dict(position))


def position_at(white: Float[Array, " entry"], whitening: Whitening, form: State) -> dict[str, Array]:
    """Return the position at whitened coordinates; `form` is any position, for the shapes."""
    unravel = ravel_pytree(jax.tree.map(lambda leaf: leaf[0], dict(form)))[1]
    values = whitening.centre + whitening.root @ white
    return jax.vmap(unravel)(values.reshape(jax.tree.leaves(dict(form))[0].shape[0], -1))


def whitened(position: State, whitening: Whitening) -> Float[Array, " entry"]:
    """Return the whitened coordinates of a position: the inverse of `position_at`."""
    # The root is upper triangular: the transpose of the inverse of a Cholesky factor.
    return jax.scipy.linalg.solve_triangular(whitening.root, flat(position).ravel() - whitening.centre, lower=False)
