"""Moments corrected by slopes: exact for a Gaussian, consistent for another law, and no worse if the slopes say little."""

from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.special import softmax

from bayes_body.kernels.smc import moment_correction

DOFS, DRAWS = 12, 150
EQUAL = np.zeros(DRAWS)


_compiled = cache(lambda name: jax.jit(getattr(moment_correction, name)))


def _called(name, *arguments):
    """A function of the module on 32-bit arrays."""
    return _compiled(name)(*(jax.tree.map(lambda leaf: jnp.asarray(leaf, jnp.float32), each) for each in arguments))


def _gaussian(seed):
    rng = np.random.default_rng(seed)
    A = rng.standard_normal((DOFS, DOFS))
    covariance, mean = A @ A.T / DOFS + 0.1 * np.eye(DOFS), rng.standard_normal(DOFS)
    draws = mean + rng.standard_normal((DRAWS, DOFS)) @ np.linalg.cholesky(covariance).T
    return rng, mean, covariance, draws, -(draws - mean) @ np.linalg.inv(covariance)


def _errors(found, mean, covariance):
    """Root mean squares, of the mean in standard deviations, and of the covariance relative to the exact one."""
    root = np.linalg.inv(np.linalg.cholesky(covariance))
    own = np.asarray(found.root, float)
    off = root @ own @ own.T @ root.T - np.eye(len(mean))
    return np.sqrt(np.mean((root @ (np.asarray(found.mean) - mean)) ** 2)), np.sqrt(np.mean(off**2))


def test_of_a_gaussian_the_moments_are_exact_whatever_the_draws():
    _, mean, covariance, draws, slopes = _gaussian(1)
    assert min(_errors(_called("moments", draws, EQUAL), mean, covariance)) > 0.05
    found = _called("corrected_moments", draws, EQUAL, slopes)
    assert max(_errors(found, mean, covariance)) < 2e-3


def test_where_the_likelihood_says_nothing_they_are_those_of_the_prior():
    """Noisy slopes in eight of twelve directions: the other four stay exact."""
    rng, mean, covariance, draws, slopes = _gaussian(2)
    root = np.linalg.cholesky(covariance)
    noisy = slopes + 2 * np.concatenate([rng.standard_normal((DRAWS, 8)), np.zeros((DRAWS, 4))], axis=1) @ np.linalg.inv(root)
    found = _called("corrected_moments", draws, EQUAL, noisy)
    off = np.linalg.solve(root, np.asarray(found.mean) - mean)
    by_draws = np.linalg.solve(root, draws.mean(axis=0) - mean)
    assert np.abs(off[8:]).max() < 0.01 < np.abs(by_draws[8:]).max()


def test_noisy_slopes_do_not_make_them_worse():
    errors = []
    for seed in range(40):
        rng, mean, covariance, draws, slopes = _gaussian(seed)
        noisy = slopes + 3 * rng.standard_normal((DRAWS, DOFS)) @ np.linalg.inv(np.linalg.cholesky(covariance))
        found = _called("corrected_moments", draws, EQUAL, noisy)
        errors.append([_errors(each, mean, covariance) for each in (_called("moments", draws, EQUAL), found)])
    plain, corrected = np.sqrt(np.mean(np.square(errors), axis=0))
    assert (corrected <= plain).all()


def test_of_a_skewed_law_they_are_right_in_the_mean():
    _check_skewed(1.0)


def test_slopes_of_the_wrong_sign_are_found_out():
    with pytest.raises(AssertionError):
        _check_skewed(-1.0)


def _check_skewed(sign):
    """Log of a Gamma variable of shape 2, independent dofs: mean digamma(2), variance trigamma(2); weighted draws of shape 2.3."""
    rng, shape = np.random.default_rng(3), 2.0
    draws = np.log(rng.gamma(2.3, size=(300, DRAWS, 3)))
    log_weights = -0.3 * draws.sum(axis=2)
    slopes = sign * (shape - np.exp(draws))
    corrected = jax.jit(jax.vmap(moment_correction.corrected_moments))
    found = corrected(*(jnp.asarray(each, jnp.float32) for each in (draws, log_weights, slopes)))
    means, variances = np.asarray(found.mean), np.sum(np.asarray(found.root) ** 2, axis=2)
    by_weights = np.asarray(jax.jit(jax.vmap(moment_correction.moments))(draws.astype(np.float32), log_weights.astype(np.float32)).mean)
    assert means.mean() == pytest.approx(0.42278, abs=0.01)
    assert variances.mean() == pytest.approx(0.64493, rel=0.03)
    assert np.mean((means - 0.42278) ** 2) < 0.7 * np.mean((by_weights - 0.42278) ** 2)


def test_draws_get_the_moments_wanted():
    draws = _gaussian(5)[3]
    log_weights = np.linspace(0, 2, DRAWS)
    wanted = _called("moments", 2 * draws + 1, EQUAL)
    found = _called("moments", _called("with_moments", draws, log_weights, wanted), log_weights)
    np.testing.assert_allclose(found.mean, wanted.mean, atol=1e-3)
    here, there = (np.asarray(moments.root) for moments in (found, wanted))
    np.testing.assert_allclose(here @ here.T, there @ there.T, atol=2e-3)
    broken = wanted._replace(mean=np.where(np.arange(DOFS) == 0, np.nan, wanted.mean))
    np.testing.assert_array_equal(_called("with_moments", draws, log_weights, broken), draws.astype(np.float32))


def test_noise_beside_draws_has_exact_moments_unless_there_are_too_few_draws():
    rng, noise_beside = np.random.default_rng(8), jax.jit(moment_correction.noise_beside, static_argnums=3)
    draws, log_weights = (rng.normal(size=(60, 3)) @ np.triu(np.ones((3, 3)))).astype(np.float32), rng.normal(size=60).astype(np.float32)
    noise, weights = np.asarray(noise_beside(jax.random.key(8), draws, log_weights, 4)), softmax(log_weights)
    assert np.abs(weights @ noise).max() < 1e-5
    # Roots of covariances have a floor of 1e-5.
    np.testing.assert_allclose((weights[:, None] * noise).T @ noise, np.eye(4), atol=1e-4)
    np.testing.assert_allclose((weights[:, None] * (draws - weights @ draws)).T @ noise, np.zeros((3, 4)), atol=1e-4)
    few = np.asarray(noise_beside(jax.random.key(8), draws[:15], log_weights[:15], 4))
    assert np.isfinite(few).all() and np.abs(softmax(log_weights[:15]) @ few).max() > 0.01
