r"""The evidence of a window of frames by bridge sampling (Meng & Wong 1996; Gronau et al. 2017), from draws of its posterior.

With draws $y_j$ of the posterior, whose density $q$ is known up to the evidence Z, and draws $\tilde y_i$ of a normal distribution g,

$$\hat Z = \frac{\frac{1}{N_2} \sum_i h(\tilde y_i)\, q(\tilde y_i)}{\frac{1}{N_1} \sum_j h(y_j)\, g(y_j)}, \qquad
h = \frac{1}{s_1 q / Z + s_2 g}, \quad s_k = \frac{N_k}{N_1 + N_2},$$

solved for Z by iteration. The first half of each chain fits g: the Gaussian process of a window (kernels/paths/window.py), which has few parameters,
so that some thousand draws fit some hundred coordinates. The second half is bridged. The relative error is that of Frühwirth-Schnatter (2004), with
the effective number of draws of the chains. It is small only if g and the posterior overlap.

A constraint, which is between 0 and 1, counts as seen: Z is the evidence of the images and of parts that do not intersect.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float

from bayes_body.base.shapes import Key
from bayes_body.density.factor import State
from bayes_body.density.trajectory import Trajectory
from bayes_body.kernels.batching import over_particles
from bayes_body.kernels.paths.window import GaussianPath, WindowDraws, gaussian_path
from bayes_body.kernels.paths.window_nuts import chain_diagnostics

# Iterations end when the log-evidence moves by less, nats. The map is a contraction: some tens of iterations are the rule.
SMALLEST, LARGEST = 1e-8, 1000
# Chains that are bridged need so many draws each, for their effective number.
FEWEST = 8


class WindowEvidence(NamedTuple):
    """The log-evidence of a window given the images before it, and its Monte Carlo error, nats; NaN if there are too few draws."""

    value: float
    error: float


def window_evidence(key: Key, target: Trajectory, draws: WindowDraws) -> WindowEvidence:
    """Return the evidence of a window by bridge sampling.

    Args:
        key: random key of the normal draws.
        target: the joint density of the window, from which the draws are.
        draws: draws of the chains.
    """
    coordinates = np.asarray(draws.coordinates, np.float64)
    chains, length, frames, dofs = coordinates.shape
    half, memory = length // 2, target.frames.transition.frames_read
    if half < FEWEST:
        return WindowEvidence(float("nan"), float("nan"))
    process = gaussian_path(coordinates[:, :half].reshape(-1, frames, dofs), frames if memory is None else memory)
    # Rounded as the target will see them.
    normal = np.asarray(_normal_draws(key, process, chains * (length - half)), draws.coordinates.dtype)
    form = jax.tree.map(lambda leaf: leaf[0, 0], dict(draws.states))
    log_target = np.asarray(_log_target(jnp.asarray(normal), target, form), np.float64)
    at_draws = np.asarray(draws.log_density, np.float64)[:, half:] - _log_gaussian(process, coordinates[:, half:])
    return bridged(at_draws, log_target - _log_gaussian(process, normal.astype(np.float64)))


def bridged(at_draws: Float[np.ndarray, "chain draw"], at_normal: Float[np.ndarray, " normal"]) -> WindowEvidence:
    """Return the evidence from the log-ratios of the unnormalised posterior to the normal distribution.

    Args:
        at_draws: at draws of the posterior.
        at_normal: at draws of the normal distribution; -∞ where the posterior is 0.
    """
    shift = float(np.median(at_draws))
    posterior, normal = np.asarray(at_draws, float) - shift, np.where(np.isnan(at_normal), -np.inf, at_normal) - shift
    share = posterior.size / (posterior.size + normal.size)
    log_shares, value = np.log([share, 1 - share]), 0.0

    def terms(value: float) -> tuple[np.ndarray, np.ndarray]:
        """Return the logarithms of h q and of h g, up to the same factor."""
        above = -np.logaddexp(log_shares[0] - value, log_shares[1] - normal)
        return above, -np.logaddexp(log_shares[0] + posterior - value, log_shares[1])

    for _ in range(LARGEST):
        above, below = terms(value)
        value, step = (moved := _log_mean(above) - _log_mean(below)), abs(moved - value)
        if step < SMALLEST or not np.isfinite(value):
            break
    if not np.isfinite(value):
        return WindowEvidence(-np.inf, np.inf)
    first, second = (np.exp(logs - logs.max()) for logs in terms(value))
    effective = float(chain_diagnostics(jnp.asarray(second[..., None]))[1][0])
    squares = first.var(ddof=1) / first.mean() ** 2 / first.size
    squares += second.var(ddof=1) / second.mean() ** 2 / (min(effective, second.size) if np.isfinite(effective) else 1.0)
    return WindowEvidence(value + shift, float(np.sqrt(squares)))


def _log_mean(logs: Float[np.ndarray, "..."]) -> float:
    return float(np.logaddexp.reduce(logs.ravel()) - np.log(logs.size))


def _normal_draws(key: Key, process: GaussianPath, count: int) -> Float[np.ndarray, "draw frame dof"]:
    """Return draws of the Gaussian process."""
    noise = np.asarray(jax.random.normal(key, (count, process.mean.size)), np.float64)
    factor = np.linalg.cholesky(process.precision)
    return process.mean + np.linalg.solve(factor.T, noise.T).T.reshape(count, *process.mean.shape)


def _log_gaussian(process: GaussianPath, coordinates: Float[np.ndarray, "*draw frame dof"]) -> Float[np.ndarray, "*draw"]:
    """Return the log-density of the Gaussian process."""
    factor = np.linalg.cholesky(process.precision)
    noise = (coordinates - process.mean).reshape(*coordinates.shape[:-2], -1) @ factor
    return np.log(np.diagonal(factor)).sum() - 0.5 * (noise**2).sum(axis=-1) - 0.5 * noise.shape[-1] * np.log(2 * np.pi)


@jax.jit
def _log_target(coordinates: Float[Array, "draw frame dof"], target: Trajectory, path: State) -> Float[Array, " draw"]:
    """Return the log-density of the window at flat coordinates; `path` is any path, for the shapes."""
    unravel = ravel_pytree(jax.tree.map(lambda leaf: leaf[0], target.position(path)))[1]
    return over_particles(lambda flat, density: density(jax.vmap(unravel)(flat)), coordinates, target)
