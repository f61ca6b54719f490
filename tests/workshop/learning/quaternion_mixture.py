r"""The paper's form of a kinematic potential, for comparison: a Gaussian mixture over position and quaternion in R^4 (Sigal et al. 2011, (6)).

Blocks 3 × 3 and 4 × 4, learned by EM from quaternions of canonical sign. The density of a pose is the sum over both signs. On rotations it is not
normalised: its integral over Haar measure is estimated by importance sampling, so that it can be compared with other densities of poses.
"""

from typing import NamedTuple

import numpy as np
from scipy.special import logsumexp
from scipy.stats import multivariate_normal
from sklearn.cluster import KMeans

from bayes_body.base.geometry import rotations
from bayes_body.model.potentials.joint_mixture import log_of_components, mixture

BLOCKS = (slice(0, 3), slice(3, 7))


class QuaternionMixture(NamedTuple):
    """Means (component, 7), covariances of both blocks, weights, and the logarithm of the integral over all poses with its standard error."""

    mean: np.ndarray
    position: np.ndarray
    quaternion: np.ndarray
    weight: np.ndarray
    log_normaliser: float = 0.0
    error: float = 0.0


def fit(poses, weights, components, floors, iterations=300):
    """The best of four fits. A quaternion of a small rotation vector w is about w / 2: its floor is half of that in radians."""
    poses = np.concatenate([poses[:, :3], rotations.canonical(poses[:, 3:])], axis=1)
    fits = []
    for seed in range(4):
        labels = KMeans(components, n_init=1, random_state=seed).fit(poses, sample_weight=weights).labels_
        shares, before = 0.9 * np.eye(components)[labels] + 0.1 / components, -np.inf
        for _ in range(iterations):
            found = _maximised(poses, weights, shares, floors)
            each = _log_of_components(found, poses)
            total = logsumexp(each, axis=1)
            now, shares = weights @ total, np.exp(each - total[:, None])
            if now - before < 1e-5:
                break
            before = now
        fits.append((now, found))
    return normalised(max(fits, key=lambda pair: pair[0])[1])


def log_density(found, poses):
    """Nats, with respect to metres³ and Haar measure."""
    mirrored = poses * np.array([1, 1, 1, -1, -1, -1, -1])
    both = [logsumexp(_log_of_components(found, each), axis=1) for each in (poses, mirrored)]
    return np.logaddexp(*both) - found.log_normaliser


def normalised(found, draws=200_000, seed=0):
    """With the integral over rotations; that over positions is 1. Proposals: its components in tangent spaces, 1.5 times as wide, and 5 % uniform."""
    rng = np.random.default_rng(seed)
    lengths = np.linalg.norm(found.mean[:, 3:], axis=1, keepdims=True)
    centres = found.mean[:, 3:] / lengths
    # Columns are the derivatives of the quaternion by the rotation vector, times 2.
    basis = np.stack([rotations.multiply(centres, np.eye(4)[k] * np.ones_like(centres)) for k in (1, 2, 3)], axis=-1)
    spread = 9.0 * np.einsum("mik,mij,mjl->mkl", basis, found.quaternion, basis)
    proposal = mixture(
        np.concatenate([np.zeros((len(centres), 3)), centres], axis=1),
        np.stack([np.tile(np.eye(3), (len(centres), 1, 1)), spread], axis=1),
        found.weight,
    )
    chosen = rng.choice(len(centres), size=draws, p=found.weight / found.weight.sum())
    vectors = np.full((draws, 3), np.inf)
    while (far := np.linalg.norm(vectors, axis=1) >= np.pi).any():
        vectors[far] = np.einsum("nij,nj->ni", proposal["root"][chosen[far], 1], rng.normal(size=(far.sum(), 3)))
    near = rotations.multiply(centres[chosen], rotations.exponential(vectors))
    q = np.where(rng.random((draws, 1)) < 0.05, rotations.normalised(rng.normal(size=(draws, 4))), near)
    at = np.concatenate([np.zeros((len(q), 3)), q], axis=1)
    own = logsumexp(log_of_components(proposal, at), axis=1) + 1.5 * np.log(2 * np.pi)
    log_proposal = np.logaddexp(np.log(0.95) + own, np.log(0.05 / (8 * np.pi**2)))
    rotation_only = found._replace(mean=np.concatenate([np.zeros((len(centres), 3)), found.mean[:, 3:]], axis=1))
    constant = np.array([multivariate_normal(np.zeros(3), each).logpdf(np.zeros(3)) for each in found.position])

    def value(q):
        poses = np.concatenate([np.zeros((len(q), 3)), q], axis=1)
        return logsumexp(_log_of_components(rotation_only, poses) - constant, axis=1)

    ratio = np.exp(np.logaddexp(value(q), value(-q)) - log_proposal)
    return found._replace(log_normaliser=float(np.log(ratio.mean())), error=float(ratio.std() / ratio.mean() / np.sqrt(len(ratio))))


def _maximised(poses, weights, shares, floors):
    own = weights[:, None] * shares
    weight = np.maximum(own.sum(axis=0), 1e-12)
    own = (own / own.sum(axis=0)).T
    mean = own @ poses
    away = poses[None] - mean[:, None]
    blocks = []
    for block, floor in zip(BLOCKS, (floors.position, floors.rotation / 2), strict=True):
        values, axes = np.linalg.eigh(np.einsum("mn,mni,mnj->mij", own, away[..., block], away[..., block]))
        blocks.append(np.einsum("mik,mk,mjk->mij", axes, np.maximum(values, floor**2), axes))
    return QuaternionMixture(mean, *blocks, weight / weight.sum())


def _log_of_components(found, poses):
    each = []
    for mean, position, quaternion, weight in zip(*found[:4], strict=True):
        logs = [multivariate_normal(mean[block], cov).logpdf(poses[:, block]) for block, cov in zip(BLOCKS, (position, quaternion), strict=True)]
        each.append(np.log(weight) + sum(logs))
    return np.stack(each, axis=1)
