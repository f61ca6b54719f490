"""EM for relative poses: mixtures that were put in are found, at the components' own means; floors hold."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from bayes_body.workshop.learning.kinematic_potentials import Floors, fit_mixture, log_density

NONE = Floors(1e-6, 1e-6)
# Rotation vectors of the means: more than a radian from each other.
TURNS = np.array([[0.0, 0.9, 0.0], [0.0, -1.1, 0.4], [1.2, 0.2, -1.0]])
PLACES = np.array([[0.0, 0.0, 0.0], [0.03, 0.0, 0.0], [0.0, -0.02, 0.05]])
SHARES = (0.5, 0.3, 0.2)
COUNT = 20_000


@pytest.fixture(scope="module")
def truth():
    """Covariances (component, block, 3, 3), with axes at random; the second component is narrow, the others reach beyond it."""
    axes = Rotation.random(6, rng=np.random.default_rng(3)).as_matrix().reshape(3, 2, 3, 3)
    sd = np.array([[[0.01, 0.02, 0.03], [0.5, 0.2, 0.1]], [[0.01, 0.01, 0.02], [0.1, 0.05, 0.2]], [[0.02, 0.01, 0.01], [0.15, 0.6, 0.3]]])
    return np.einsum("mbik,mbk,mbjk->mbij", axes, sd**2, axes)


@pytest.fixture(scope="module")
def draws(truth):
    """Poses and their components: vectors by another library's exponential map."""
    rng = np.random.default_rng(4)
    component = rng.choice(3, size=COUNT, p=SHARES)
    xi = np.einsum("nbij,nbj->nbi", np.linalg.cholesky(truth)[component], rng.normal(size=(COUNT, 2, 3)))
    means = Rotation.from_rotvec(TURNS[component])
    places = PLACES[component] + means.apply(xi[:, 0])
    turns = (means * Rotation.from_rotvec(xi[:, 1])).as_quat(scalar_first=True)
    return np.concatenate([places, turns * rng.choice([-1, 1], size=(COUNT, 1))], axis=1), component


@pytest.fixture(scope="module")
def found(draws):
    fit = fit_mixture(draws[0], np.full(COUNT, 1 / COUNT), 3, NONE)
    order = np.argmin(np.linalg.norm(fit.mean[None, :, 3:] - _quaternions(TURNS)[:, None], axis=-1), axis=1)
    return fit, order


def _quaternions(vectors):
    return Rotation.from_rotvec(vectors).as_quat(canonical=True, scalar_first=True)


def test_a_mixture_is_found(found, draws, truth):
    """Within five standard errors of draws whose components are known, which is a little more than EM's own."""
    fit, order = found
    assert sorted(order) == [0, 1, 2]
    counts = np.bincount(draws[1])
    np.testing.assert_allclose(fit.weight[order], SHARES, atol=5 * np.sqrt(0.25 / COUNT))
    for m, own in enumerate(order):
        errors = (Rotation.from_rotvec(TURNS[m]).inv() * Rotation.from_quat(fit.mean[own, 3:], scalar_first=True)).as_rotvec()
        assert np.abs(errors).max() < 5 * np.sqrt(np.linalg.eigvalsh(truth[m, 1]).max() / counts[m])
        assert np.abs(fit.mean[own, :3] - PLACES[m]).max() < 5 * np.sqrt(np.linalg.eigvalsh(truth[m, 0]).max() / counts[m])
        for block in (0, 1):
            # In the axes of the truth, the covariance is the identity.
            root = np.linalg.inv(np.linalg.cholesky(truth[m, block]))
            assert np.abs(root @ fit.covariance[own, block] @ root.T - np.eye(3)).max() < 5 * np.sqrt(2 / counts[m])


def test_it_is_no_less_likely_than_the_truth(found, draws, truth):
    fit, _ = found
    known = fit._replace(mean=np.concatenate([PLACES, _quaternions(TURNS)], axis=1), covariance=truth, weight=np.array(SHARES))
    gain = log_density(fit, draws[0]) - log_density(known, draws[0])
    assert gain.mean() > 0
    assert fit.log_likelihood == pytest.approx(log_density(fit, draws[0]).mean(), abs=1e-9)


def test_quaternions_have_canonical_signs(found):
    assert (found[0].mean[:, 3] > 0).all()


def test_weights_of_draws_count(draws):
    """Draws of weight 0 are as if they were not there."""
    poses, component = draws
    weights = np.where(component == 1, 1 / (component == 1).sum(), 0.0)
    fit, alone = fit_mixture(poses, weights, 1, NONE), fit_mixture(poses[component == 1], weights[component == 1], 1, NONE)
    np.testing.assert_allclose(fit.mean, alone.mean, atol=1e-9)
    np.testing.assert_allclose(fit.covariance, alone.covariance, atol=1e-9)


@pytest.mark.parametrize("components", [1, 4])
def test_a_joint_that_does_not_move_has_the_floors(components):
    poses = np.tile(np.concatenate([PLACES[2], _quaternions(TURNS[2])]), (50, 1))
    fit = fit_mixture(poses, np.full(50, 0.02), components, Floors(0.01, 0.05))
    np.testing.assert_allclose(fit.mean, poses[:components], atol=1e-9)
    np.testing.assert_allclose(fit.covariance[:, 0], np.tile(0.01**2 * np.eye(3), (components, 1, 1)), atol=1e-12)
    np.testing.assert_allclose(fit.covariance[:, 1], np.tile(0.05**2 * np.eye(3), (components, 1, 1)), atol=1e-12)
    # All mass of a narrow Gaussian is within a half turn, and the map is flat at its mean.
    assert fit.log_likelihood == pytest.approx(-3 * np.log(2 * np.pi * 0.01 * 0.05), abs=1e-6)


def test_a_floor_changes_only_the_narrow_axes(draws):
    poses, component = draws
    own = poses[component == 0]
    weights = np.full(len(own), 1 / len(own))
    free, floored = (fit_mixture(own, weights, 1, floors).covariance[0, 1] for floors in (NONE, Floors(1e-6, 0.3)))
    free, floored = np.linalg.eigvalsh(free), np.linalg.eigvalsh(floored)
    np.testing.assert_allclose(floored, np.maximum(free, 0.09), rtol=1e-9)
    assert (free < 0.09).sum() == 2
