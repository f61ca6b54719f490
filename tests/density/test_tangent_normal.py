"""Normal distributions around a point: normalised over the circle, all rotations and all rigid transforms, with draws of that density."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import norm

from bayes_body.base.geometry import rotations
from bayes_body.density.spaces import SE3, SO3, Flat, circle, euclidean
from bayes_body.density.tangent_normal import WIDEST_RAD, fit, tangent_normal

# As wide as a fit goes about one axis: 5 % of the tangent vectors are longer than half a turn.
WIDE = np.array([WIDEST_RAD, 0.9, 1.0])
VOLUME = 8 * math.pi**2
COUNT = 40_000


def rotation_normal(sd=WIDE):
    mean = np.array([0.5, -0.5, 0.5, 0.5])
    axes = Rotation.from_rotvec([0.3, -0.4, 0.2]).as_matrix()
    return tangent_normal(SO3(), jnp.asarray(mean, jnp.float32), jnp.asarray(axes @ np.diag(sd**2) @ axes.T, jnp.float32))


def uniform(seed):
    return jnp.asarray(Rotation.random(COUNT, rng=np.random.default_rng(seed)).as_quat(scalar_first=True), jnp.float32)


def densities(normal, points):
    return np.exp(np.asarray(jax.jit(jax.vmap(normal.log_prob))(points), float))


def samples(normal, seed=0):
    return jax.jit(jax.vmap(normal.sample))(jax.random.split(jax.random.key(seed), COUNT))


def errors(weights, values=None):
    """How many Monte Carlo standard errors the mean of the weights is from 1, or that of weighted values from zero."""
    each = weights - 1 if values is None else weights * values
    return abs(each.mean()) / (each.std() / len(each) ** 0.5)


def test_on_rotations_it_is_normalised():
    weights = VOLUME * densities(rotation_normal(), uniform(1))
    assert errors(weights) < 4
    assert weights.std() / COUNT**0.5 < 0.01


def test_draws_of_rotations_have_the_density():
    """Moments of the rotation's matrix, which the sign of a quaternion does not change, by draws and by uniform points weighted with the density."""
    normal, points = rotation_normal(), uniform(2)
    weighted = VOLUME * densities(normal, points)[:, None, None] * rotations.to_matrix(np.asarray(points, float))
    drawn = rotations.to_matrix(np.asarray(samples(normal), float))
    error = np.sqrt((weighted.var(0) + drawn.var(0)) / COUNT)
    assert np.all(np.abs(weighted.mean(0) - drawn.mean(0)) < 4 * error)
    assert error.max() < 0.01


def test_without_the_other_way_round_a_wide_one_is_not_normalised(monkeypatch):
    monkeypatch.setattr(SO3, "images", lambda self, v: v[..., None, :])
    assert errors(VOLUME * densities(rotation_normal(), uniform(1))) > 5


def test_a_difference_that_is_not_wrapped_is_found_out(monkeypatch):
    """Of angles on both sides of π."""
    normal = tangent_normal(circle(("yaw",)), jnp.asarray([3.0]), jnp.asarray([[0.3**2]]))
    there = jnp.asarray([-3.0])
    right = float(normal.log_prob(there))
    assert right == pytest.approx(norm.logpdf(2 * math.pi - 6, scale=0.3), abs=1e-4)
    monkeypatch.setattr(Flat, "_turns", lambda self, difference: 0 * difference)
    monkeypatch.setattr(Flat, "images", lambda self, v: v[..., None, :])
    assert float(normal.log_prob(there)) < right - 10


def test_on_rigid_transforms_it_is_normalised():
    """Position and rotation depend on each other; the positions of the points are normal with a larger width."""
    rng = np.random.default_rng(3)
    mix = np.diag([0.05, 0.02, 0.03, *WIDE]) @ np.linalg.cholesky(0.6 * np.eye(6) + 0.4)
    mean = np.array([1.0, -2.0, 0.5, 0.5, -0.5, 0.5, 0.5])
    normal = tangent_normal(SE3(), jnp.asarray(mean, jnp.float32), jnp.asarray(mix @ mix.T, jnp.float32))
    off = 0.08 * rng.normal(size=(COUNT, 3))
    points = np.concatenate([mean[:3] + off, uniform(4)], axis=1).astype(np.float32)
    weights = VOLUME * densities(normal, points) / np.exp(norm.logpdf(off, scale=0.08).sum(axis=1))
    assert errors(weights) < 4
    assert weights.std() / COUNT**0.5 < 0.06
    # The other way about: draws, with the density of other points.
    drawn = samples(normal)
    other = np.exp(norm.logpdf(np.asarray(drawn[:, :3], float) - mean[:3], scale=0.01).sum(axis=1)) / VOLUME
    assert errors(other / densities(normal, drawn)) < 4


def test_on_the_circle_it_is_normalised_and_is_the_wrapped_normal():
    grid = np.linspace(-math.pi, math.pi, 2001)[:-1]
    normal = tangent_normal(circle(("yaw",)), jnp.asarray([2.5]), jnp.asarray([[WIDEST_RAD**2]]))
    density = densities(normal, jnp.asarray(grid[:, None], jnp.float32))
    turns = 2 * math.pi * np.arange(-5, 6)
    exact = norm.pdf(grid[:, None] - 2.5 + turns, scale=WIDEST_RAD).sum(axis=1)
    np.testing.assert_allclose(density, exact, atol=2e-5)
    assert density.mean() * 2 * math.pi == pytest.approx(1, abs=1e-4)


def fits_of_both_signs():
    """Log-densities of fits to weighted rotations, and to the same with the signs of some quaternions changed, at the same points."""
    points = np.asarray(samples(rotation_normal(np.array([0.5, 0.3, 0.2]))))[:500]
    weights = jnp.asarray(np.random.default_rng(5).dirichlet(np.ones(500)), jnp.float32)
    signs = np.where(np.arange(500) % 3 == 0, -1, 1).astype(np.float32)[:, None]
    # A lambda, since JAX would give back what was compiled of the function before a test changes what it calls.
    fitted = jax.jit(lambda points: fit(SO3(), weights, points, 1.5))
    one, other = (fitted(each) for each in (points, signs * points))
    where = uniform(6)[:200]
    return [np.log(densities(one, where)), np.log(densities(other, where)), np.log(densities(one, -where))]


@pytest.mark.slow
def test_a_fit_does_not_see_the_sign_of_a_quaternion():
    found = fits_of_both_signs()
    np.testing.assert_allclose(found[1], found[0], rtol=1e-3, atol=1e-2)
    np.testing.assert_allclose(found[2], found[0], rtol=1e-3, atol=1e-2)


@pytest.mark.slow
def test_a_logarithm_that_sees_the_sign_is_found_out(monkeypatch):
    """One that does not choose between q and -q: some of the vectors are then longer than half a turn."""
    monkeypatch.setattr(rotations, "canonical", lambda q: q)
    found = fits_of_both_signs()
    assert np.abs(found[1] - found[0]).max() > 1


def test_what_a_prediction_leaves_of_a_normal():
    """In a flat space the product of two densities is the integral times the third one, exactly."""
    rng, plane = np.random.default_rng(3), euclidean(("x", "y"), ("m", "m"))
    covariances = [root @ root.T + 0.1 * np.eye(2) for root in rng.normal(size=(2, 2, 2))]
    means = rng.normal(size=(2, 2))
    seen, predicted = (tangent_normal(plane, *(jnp.asarray(each, jnp.float32) for each in pair)) for pair in zip(means, covariances, strict=True))
    points = jnp.asarray(rng.normal(size=(20, 2)), jnp.float32)
    product, log_integral = jax.jit(lambda seen, predicted: seen.combine(predicted))(seen, predicted)
    log_densities = jax.jit(lambda normal: jax.vmap(normal.log_prob)(points))
    np.testing.assert_allclose(log_densities(product) + log_integral, log_densities(seen) + log_densities(predicted), atol=1e-3)


def test_an_unknown_turn_follows_the_prediction():
    """The origin and the axis are detected, the turn about z is not; it is predicted 100 degrees away."""
    sd = np.array([0.02, 0.02, 0.02, 0.1, 0.1, WIDEST_RAD])
    turn = Rotation.from_euler("z", 100, degrees=True).as_quat(scalar_first=True)
    seen = tangent_normal(SE3(), jnp.asarray([0.1, 0, 0, 1, 0, 0, 0], jnp.float32), jnp.asarray(np.diag(sd**2), jnp.float32))
    predicted = tangent_normal(SE3(), jnp.asarray([0, 0, 0, *turn], jnp.float32), jnp.asarray(np.diag([0.1] * 6) ** 2, jnp.float32))
    chosen, _ = jax.jit(lambda seen, predicted: seen.combine(predicted))(seen, predicted)
    away = np.degrees(Rotation.from_quat(np.asarray(chosen.mean[3:], float), scalar_first=True).as_rotvec())
    np.testing.assert_allclose(away, [0, 0, 100 * 1.44 / 1.45], atol=0.1)
    np.testing.assert_allclose(chosen.mean[:3], [0.1 * 0.01 / 0.0104, 0, 0], atol=1e-4)
