r"""Whitened coordinates of a window of frames, fitted to smoothed paths.

A motion prior couples neighbouring frames strongly: a random walk of small steps lets a window move as a whole, but hardly one frame alone. A sampler
with a diagonal metric would take as many leapfrog steps as the ratio of these widths. The paths are therefore taken as a Gaussian process with the
transition's memory $m$: each frame is a regression on the $m$ frames before,

$$x_t = \mu_t + \sum_{k=1}^{m} A_{tk} (x_{t-k} - \mu_{t-k}) + \epsilon_t, \qquad P = J^\top \mathrm{diag}(S_t^{-1})\, J,$$

with the residuals' covariances $S_t$ and the rows $J_t = (-A_{tm}, \dots, -A_{t1}, 1)$. This is the maximum likelihood under that structure. It needs
some more paths than $m$ frames have dofs, while a covariance of the whole window would need more paths than the window has dofs. The precision of a
window given the rest of its path is a block of $P$. With $P = C C^\top$, a standard normal $z$ gives $\mu + C^{-\top} z$.
"""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

# With fewer paths than this many for each predictor, a frame is taken as the frame before and a step.
PATHS_PER_PREDICTOR = 2
# The share by which a residual's covariance is shrunk towards its diagonal, as in kernels/smc/moves.py.
SHRUNK = 0.1


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
    """Return the Gaussian process of paths.

    Args:
        values: coordinates of the paths.
        memory: number of frames before that a frame depends on.
    """
    values = np.asarray(values, np.float64)
    paths, frames, dofs = values.shape
    mean = values.mean(axis=0)
    centred, precision = values - mean, np.zeros((frames * dofs,) * 2)
    for frame in range(frames):
        first = max(frame - memory, 0)
        before = centred[:, first:frame].reshape(paths, -1)
        weights, known = _regression(before, centred[:, frame])
        residual = _covariance(centred[:, frame] - before @ weights, paths - 1 - known)
        row = np.concatenate([-weights.T, np.eye(dofs)], axis=1)
        part = slice(first * dofs, (frame + 1) * dofs)
        precision[part, part] += row.T @ np.linalg.solve(residual, row)
    return GaussianPath(mean, precision)


def _regression(
    before: Float[np.ndarray, "path predictor"], current: Float[np.ndarray, "path dof"]
) -> tuple[Float[np.ndarray, "predictor dof"], int]:
    """Return the weights of the predictors, and how many of them were estimated."""
    (paths, predictors), dofs = before.shape, current.shape[1]
    if paths > PATHS_PER_PREDICTOR * predictors:
        return np.linalg.lstsq(before, current, rcond=None)[0], predictors
    return np.concatenate([np.zeros((predictors - dofs, dofs)), np.eye(dofs)]), 0


def _covariance(residuals: Float[np.ndarray, "path dof"], freedom: int) -> Float[np.ndarray, "dof dof"]:
    covariance = residuals.T @ residuals / max(freedom, 1)
    variances = np.diagonal(covariance)
    return (1 - SHRUNK) * covariance + np.diag(SHRUNK * variances + max(1e-6 * variances.max(), 1e-10))
