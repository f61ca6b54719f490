r"""A density of a relative pose Y: a Gaussian mixture in the tangent spaces at mean relative poses (Sigal et al. 2011, (6)).

$$g(Y) = \sum_m \delta_m\, \frac{\mathcal N(v_m; 0, \Sigma^v_m)\, \mathcal N(\omega_m; 0, \Sigma^\omega_m)}{P_m\, J(\omega_m)}, \qquad
\xi_m = (v_m, \omega_m) = \mathrm{Exp}^{-1}(\bar Y_m^{-1} Y).$$

The covariance is block-diagonal: a block for the position, in the axes of the mean child's frame, and one for the rotation vector.
$J = 2 (1 - \cos|\omega|) / |\omega|^2$ is the Jacobian of the exponential map. $P_m$ is the mass of the Gaussian within a half turn. g is therefore
normalised with respect to the Haar measure $dt\,dR$. It does not change under q → −q.

A mixture is a mapping of arrays: `mean` (component, 7); `root` (component, 2, 3, 3), lower-triangular, with $\Sigma = L L^T$ for each block;
`inverse_root`, its inverse; `weight` (component,); `log_weight` (component,), the log-weights with all constants of the Gaussians; `log_mass`
(component,), $\log P_m$.
"""

import math
from collections.abc import Mapping
from functools import cache
from typing import Any

import numpy as np
from jaxtyping import Array, Float
from scipy.stats import norm, qmc

from bayes_body.base.geometry import rigid, rotations
from bayes_body.base.geometry.namespaces import namespace

# Points of the quasi-random sum for the mass within a half turn: its error is below 1e-5.
POINTS = 2**15

type Numbers = Float[Array | np.ndarray, "..."]
type Mixture = Mapping[str, Any]


def mixture(
    mean: Float[np.ndarray, "*batch component 7"],
    covariance: Float[np.ndarray, "*batch component 2 3 3"],
    weight: Float[np.ndarray, "*batch component"],
) -> dict[str, np.ndarray]:
    """Return the arrays of a mixture, or of a batch of them.

    Args:
        mean: mean relative poses, metres and unit quaternions.
        covariance: of the position, metres², and of the rotation vector, radians²; positive definite.
        weight: positive; the weights of a mixture are scaled to the sum 1.
    """
    root = np.linalg.cholesky(covariance)
    weight = weight / weight.sum(axis=-1, keepdims=True)
    log_volume = np.log(np.diagonal(root, axis1=-2, axis2=-1)).sum(axis=(-2, -1))
    log_mass = np.log(within_half_turn(covariance[..., 1, :, :]))
    log_weight = np.log(weight) - log_volume - 3 * math.log(2 * math.pi) - log_mass
    return {"mean": mean, "root": root, "inverse_root": np.linalg.inv(root), "weight": weight, "log_weight": log_weight, "log_mass": log_mass}


def log_of_components(arrays: Mixture, relative: rigid.Rigid) -> Numbers:
    """Return the log-density of each component times its weight, (..., component).

    Args:
        arrays: a mixture, of JAX or of NumPy.
        relative: the pose of the child in its parent's frame, (..., 7).
    """
    xp = namespace(arrays["mean"], relative)
    steps = rigid.relative(arrays["mean"], relative[..., None, :])
    w = rotations.logarithm(steps[..., 3:])
    z = times(arrays["inverse_root"], xp.stack([steps[..., :3], w], axis=-2))
    return arrays["log_weight"] - 0.5 * xp.sum(z * z, axis=(-2, -1)) - rotations.log_jacobian(w)


def times(matrix: Numbers, vector: Numbers) -> Numbers:
    """Return the products of matrices (..., 3, 3) and vectors (..., 3), elementwise (see `geometry.transforms`)."""
    return sum((matrix[..., k] * vector[..., k : k + 1] for k in range(1, 3)), matrix[..., 0] * vector[..., :1])


def within_half_turn(covariance: Float[np.ndarray, "*batch 3 3"]) -> Float[np.ndarray, "*batch"]:
    """Return the probability that a normal rotation vector with this covariance, radians², is shorter than π."""
    # The length of a vector does not depend on the axes: those of the covariance itself make its entries independent.
    variances = np.linalg.eigvalsh(covariance)
    return np.mean(variances @ _squares() < math.pi**2, axis=-1)


@cache
def _squares() -> Float[np.ndarray, "3 point"]:
    return norm.ppf(qmc.Sobol(3, scramble=True, rng=0).random(POINTS)).T ** 2
