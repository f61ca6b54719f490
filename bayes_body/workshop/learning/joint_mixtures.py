r"""Fit of a Gaussian mixture to relative poses, in the tangent spaces at the components' own means (Sigal et al. 2011, (6)), by EM.

$$r_{nm} \propto \delta_m\, g_m(Y_n), \qquad \bar Y_m = \arg\min_Y \sum_n w_n r_{nm}\, d(Y, Y_n)^2, \qquad
\Sigma_m = \frac{\sum_n w_n r_{nm}\, \xi_{nm} \xi_{nm}^T}{\sum_n w_n r_{nm}}, \quad \xi_{nm} = \mathrm{Exp}^{-1}(\bar Y_m^{-1} Y_n)$$

for the blocks of position and rotation separately. EM starts from the clusters of scikit-learn's `KMeans`. Its steps are written out here, because
scikit-learn's `GaussianMixture` has no block-diagonal covariances, no weights of draws, and one vector space for all components. The tangent space
at one point distorts rotations that are a radian or more away.

The intrinsic mean and this covariance maximise the likelihood up to the curvature of the rotations within a component, and up to the floors. The
iterate with the largest likelihood is returned.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.special import logsumexp
from sklearn.cluster import KMeans

from bayes_body.base.geometry import rigid, rotations
from bayes_body.density.spaces import SE3, SO3
from bayes_body.model.potentials.joint_mixture import log_of_components, mixture

ITERATIONS, ENOUGH = 300, 1e-5
STARTS = 4
# The share of each draw that all clusters have in common at the start, so that none is empty.
COMMON = 0.1


class Fitted(NamedTuple):
    """A mixture: mean relative poses, covariances of position (metres²) and rotation (radians²), weights, and the log-likelihood of a draw, nats."""

    mean: Float[np.ndarray, "component 7"]
    covariance: Float[np.ndarray, "component 2 3 3"]
    weight: Float[np.ndarray, " component"]
    log_likelihood: float


class Floors(NamedTuple):
    """No standard deviation along any axis is smaller than these: metres of position, radians of rotation."""

    position: float
    rotation: float


def fit_mixture(poses: Float[np.ndarray, "draw 7"], weights: Float[np.ndarray, " draw"], components: int, floors: Floors) -> Fitted:
    """Return the best of several fits.

    Args:
        poses: relative poses.
        weights: of the poses, of sum 1.
        components: number of components.
        floors: smallest standard deviations.
    """
    centre = SE3().mean(weights, poses)
    flat = SE3().local(centre, poses)
    # More clusters than different poses would be empty.
    clusters = min(components, len(np.unique(flat, axis=0)))
    starts = STARTS if clusters > 1 else 1
    labels = [KMeans(clusters, random_state=seed).fit(flat, sample_weight=weights).labels_ for seed in range(starts)]
    fits = [_climb(poses, weights, (1 - COMMON) * np.eye(components)[clustering] + COMMON / components, floors) for clustering in labels]
    return max(fits, key=lambda fit: fit.log_likelihood)


def log_density(fitted: Fitted, poses: Float[np.ndarray, "draw 7"]) -> Float[np.ndarray, " draw"]:
    """Return the log-density of relative poses under a mixture, nats; with respect to metres³ and Haar measure."""
    return np.asarray(logsumexp(log_of_components(mixture(*fitted[:3]), poses), axis=1))


def _climb(poses: np.ndarray, weights: np.ndarray, shares: Float[np.ndarray, "draw component"], floors: Floors) -> Fitted:
    best, before = None, -np.inf
    for _ in range(ITERATIONS):
        mean, covariance, weight = _maximised(poses, weights, shares, floors)
        log_densities = log_of_components(mixture(mean, covariance, weight), poses)
        total = logsumexp(log_densities, axis=1, keepdims=True)
        log_likelihood = float(weights @ total[:, 0])
        if best is None or log_likelihood > best.log_likelihood:
            best = Fitted(mean, covariance, weight, log_likelihood)
        if log_likelihood - before < ENOUGH:
            break
        before, shares = log_likelihood, np.exp(log_densities - total)
    assert best is not None
    return best


def _maximised(poses: np.ndarray, weights: np.ndarray, shares: np.ndarray, floors: Floors) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    responsibilities = weights[:, None] * shares
    # A component that loses all its draws keeps a weight above 0, whose logarithm is finite.
    weight = np.maximum(responsibilities.sum(axis=0), 1e-12)
    responsibilities = (responsibilities / responsibilities.sum(axis=0)).T
    mean = np.asarray(rigid.rigid(responsibilities @ poses[:, :3], rotations.canonical(SO3().mean(responsibilities, poses[:, 3:]))))
    steps = rigid.relative(mean[:, None], poses[None])
    xi = np.stack([steps[..., :3], rotations.logarithm(steps[..., 3:])], axis=1)
    covariance = np.einsum("mn,mbni,mbnj->mbij", responsibilities, xi, xi)
    return mean, _floored(covariance, floors), weight / weight.sum()


def _floored(covariance: Float[np.ndarray, "component 2 3 3"], floors: Floors) -> Float[np.ndarray, "component 2 3 3"]:
    values, axes = np.linalg.eigh(covariance)
    values = np.maximum(values, np.square(floors)[:, None])
    return np.einsum("mbik,mbk,mbjk->mbij", axes, values, axes)
