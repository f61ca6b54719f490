r"""Means of Markov chains with far less variance, from the gradients at their draws (Assaraf & Caffarel 1999; Mira, Solgi & Imparato 2013).

With unconstrained coordinates y and the score $g = \nabla \log p(y)$, the functions $g_i$ and $y_j g_i + \delta_{ij}$ have the mean 0 under the
posterior (Stein's identity). What they explain of a pose is subtracted from it: all of it if the pose is a quadratic function of y and p is normal.
The weights are fitted to the draws of one run and used for the other, so that a run's mean does not depend on weights fitted to its own noise.
"""

from collections.abc import Sequence

import jax
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float

from bayes_body.density.density import Density, Unconstrained
from bayes_body.density.factor import State
from bayes_body.kernels.batching import over_particles

type Values = Float[np.ndarray, "draw dof"]


@jax.jit
def positions_and_scores(states: State, density: Density) -> tuple[Float[Array, "draw dof"], Float[Array, "draw dof"]]:
    """Return the unconstrained coordinates of states (draw, ...), and the gradients of the log-density there."""

    def score(state: State, target: Unconstrained) -> tuple[Array, Array]:
        position, unravel = ravel_pytree(target.unconstrain(state))
        return position, jax.grad(lambda flat: target(unravel(flat)))(position)

    return over_particles(score, dict(states), density.unconstrained())


def steadied(
    values: Sequence[Float[np.ndarray, "draw dof"]],
    positions: Sequence[Float[np.ndarray, "draw dof"]],
    scores: Sequence[Float[np.ndarray, "draw dof"]],
) -> list[Float[np.ndarray, "draw dof"]]:
    """Return the values of two runs with the same means and less variance; as they are if a score is not finite.

    Args:
        values: what is averaged, of each run.
        positions: coordinates of the same draws.
        scores: gradients of the log-density there.
    """
    if not all(np.isfinite(array).all() for pair in (positions, scores) for array in pair):
        return [np.asarray(of_run, float) for of_run in values]
    pooled = np.concatenate(positions)
    centre, root = pooled.mean(axis=0), np.linalg.cholesky(np.atleast_2d(np.cov(pooled.T)))
    features = [_features(np.linalg.solve(root, (y - centre).T).T, g @ root) for y, g in zip(positions, scores, strict=True)]
    weights = [np.linalg.lstsq(phi - phi.mean(axis=0), f - f.mean(axis=0), rcond=None)[0] for phi, f in zip(features, values, strict=True)]
    return [np.asarray(f, float) - phi @ of_other for f, phi, of_other in zip(values, features, reversed(weights), strict=True)]


def _features(white: Float[np.ndarray, "draw dof"], scores: Float[np.ndarray, "draw dof"]) -> Float[np.ndarray, "draw feature"]:
    """Return the functions of mean 0 at draws in whitened coordinates."""
    draws, dofs = white.shape
    products = white[:, :, None] * scores[:, None, :] + np.eye(dofs)
    return np.concatenate([scores, products.reshape(draws, -1)], axis=1)
