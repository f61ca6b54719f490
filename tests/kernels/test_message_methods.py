"""Parts of the methods of message passing: kernel estimates, sites of expectation propagation, products of messages, and strata."""

import jax
import jax.numpy as jnp
import numpy as np
import numpyro.distributions as dist
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import norm

from bayes_body.density.pairwise import edge_factor, graph, proposal
from bayes_body.density.spaces import SE3, SO3, euclidean
from bayes_body.density.tangent_normal import tangent_normal
from bayes_body.kernels.messages import epbp, products
from bayes_body.kernels.messages.methods import KernelEstimate
from bayes_body.kernels.messages.pampas import stratified
from bayes_body.kernels.messages.products import Product, draw_products, slots_of, ways

LINE = euclidean(("x",), ("m",))


@pytest.mark.slow
def test_a_kernel_estimate_of_rotations_is_normalised_and_does_not_see_signs():
    rng = np.random.default_rng(0)
    points = Rotation.random(30, rng=rng).as_quat(scalar_first=True)
    kernel = tangent_normal(SO3(), jnp.asarray([1.0, 0, 0, 0]), jnp.diag(jnp.asarray([0.6, 0.4, 0.8]) ** 2))
    log_weights = jnp.log(jnp.asarray(rng.dirichlet(np.ones(30)), jnp.float32))
    signs = np.where(np.arange(30) % 2, -1.0, 1.0)[:, None]
    one, other = (KernelEstimate(kernel, jnp.asarray(each, jnp.float32), log_weights) for each in (points, signs * points))
    uniform = jnp.asarray(Rotation.random(20_000, rng=rng).as_quat(scalar_first=True), jnp.float32)
    densities = [np.exp(np.asarray(jax.jit(jax.vmap(each.log_prob))(uniform), float)) for each in (one, other)]
    np.testing.assert_allclose(densities[1], densities[0], rtol=1e-3, atol=1e-4)
    weights = 8 * np.pi**2 * densities[0]
    assert abs(weights.mean() - 1) < 4 * weights.std() / len(weights) ** 0.5
    # Draws have this density: the mean of a test density is the same by draws and by weighted uniform rotations.
    drawn = jax.jit(jax.vmap(one.sample))(jax.random.split(jax.random.key(1), 20_000))
    tests = [np.exp(np.asarray(jax.vmap(one._component(one.points[3]).log_prob)(each), float)) for each in (drawn, uniform)]
    means, errors = zip(*[(each.mean(), each.std() / len(each) ** 0.5) for each in (tests[0], weights * tests[1])], strict=True)
    assert abs(means[0] - means[1]) < 4 * np.hypot(*errors)


@jax.jit
def sites_of(factors, v, log_drawn, sites=None):
    """Sites after one update, on a line."""
    if sites is None:
        zero = jnp.zeros((len(factors), 1, 1))
        sites = epbp.Sites(zero, zero[..., 0], jnp.zeros(1), jnp.ones(()))
    return epbp._updated(sites, v, factors, log_drawn, jnp.zeros(1))


def test_sites_of_normal_factors_are_these_factors():
    """Whatever the particles were drawn from, and in one update."""
    v = (2.0 * np.random.default_rng(0).normal(size=(40_000, 1)) + 0.5).astype(np.float32)
    log_drawn = norm.logpdf(v[:, 0], 0.5, 2.0).astype(np.float32)
    factors = np.stack([norm.logpdf(v[:, 0], mean, sd) for mean, sd in ((1.0, 1.5), (-0.5, 1.0), (2.0, 2.5))]).astype(np.float32)
    sites = sites_of(factors, v, log_drawn)
    np.testing.assert_allclose(sites.precision[:, 0, 0], [1.5**-2, 1.0, 2.5**-2], atol=0.05)
    np.testing.assert_allclose(sites.shift[:, 0], [1.5**-2, -0.5, 2.0 * 2.5**-2], atol=0.05)


def test_updates_that_cannot_be_made_are_discarded():
    v = np.random.default_rng(0).normal(size=(200, 1)).astype(np.float32)
    log_drawn = norm.logpdf(v[:, 0]).astype(np.float32)
    flat, pointed = np.zeros(200, np.float32), np.where(np.arange(200) == 7, 0.0, -np.inf).astype(np.float32)
    assert not np.asarray(sites_of(np.stack([flat, pointed]), v, log_drawn).precision).any()
    # A cavity that is no distribution: the other site is negative.
    negative = epbp.Sites(jnp.asarray([2.0, -1.0])[:, None, None], jnp.zeros((2, 1)), jnp.zeros(1), jnp.ones(()))
    after = sites_of(np.stack([flat + v[:, 0], flat]), v, log_drawn, negative)
    np.testing.assert_array_equal(after.precision, negative.precision)


def test_moved_sites_are_the_same_normal_distribution_near_the_new_point():
    """The sites' quadratic forms agree at vectors that lead to the same places, to second order in the distance from the new point."""
    reference = np.array([0.3, -0.2, 0.1, *Rotation.from_rotvec([0.2, 1.0, -0.4]).as_quat(scalar_first=True)], np.float32)
    root = np.random.default_rng(1).normal(size=(2, 6, 6)).astype(np.float32)
    precision, shift = root @ np.swapaxes(root, 1, 2), np.random.default_rng(2).normal(size=(2, 6)).astype(np.float32)
    sites = epbp.Sites(*map(jnp.asarray, (precision, shift, reference)), jnp.ones(()))
    point = SE3().retract(reference, np.array([0.1, 0.2, 0.0, 0.7, -0.5, 0.6], np.float32))
    steps = 0.01 * np.concatenate([np.zeros((1, 6)), np.eye(6), -np.eye(6)]).astype(np.float32)

    @jax.jit
    def changes(sites, point):
        moved = epbp._moved(SE3(), sites, point)
        return jax.vmap(lambda step: energies(sites, SE3().retract(point, step)) - energies(moved, SE3().retract(point, step)))(steps)

    def energies(sites, x):
        v = SE3().local(sites.reference, x)
        return 0.5 * jnp.einsum("i,kij,j->k", v, sites.precision, v) - sites.shift @ v

    at_point, *near = np.asarray(changes(sites, jnp.asarray(point)), float)
    np.testing.assert_allclose(near, np.broadcast_to(at_point, (12, 2)), atol=3e-3)


# -- products of messages ---------------------------------------------------------------------------------------------------------------------

FAR, WIDTH = 4.0, 0.5


def log_ring(first, second):
    """The second point is on a ring around the first."""
    radius = jnp.sqrt(jnp.sum((second - first) ** 2) + 1e-12)
    return dist.Normal(FAR, WIDTH).log_prob(radius) - jnp.log(2 * jnp.pi * radius)


def draw_ring(key, parameters, known, reverse):
    del parameters, reverse
    angle_key, radius_key = jax.random.split(key)
    angle, radius = 2 * jnp.pi * jax.random.uniform(angle_key), FAR + WIDTH * jax.random.normal(radius_key)
    return known + radius * jnp.stack([jnp.cos(angle), jnp.sin(angle)])


def drawn_product(factor, points, weights, draw=None, count=4000):
    """Draws of node 2, into which nodes 0 and 1 send messages from weighted particles."""
    built = graph(
        {"x": (3, points.shape[-1])},
        edge_factor("edge", factor, [(0, 2), (1, 2)], draw=draw),
        proposal("wide", dist.Normal(0.0, 5.0).expand([points.shape[-1]]).to_event(1)),
    )
    # The messages to node 2 have the numbers 0 and 1; those back, 2 and 3, are not taken.
    taken = jnp.zeros((3, count, slots_of(built).shape[1])).at[2].set(1.0)
    rows, targets = zip(*((np.arange(len(way.targets)), way.targets) for way in ways(built)), strict=True)
    product = Product(
        rows, jnp.concatenate([points, points]), jnp.log(jnp.concatenate([weights, weights])), np.concatenate(targets), slots_of(built), taken
    )
    start = jnp.zeros((3, count, points.shape[-1]))
    return np.asarray(jax.jit(lambda key: draw_products(key, built, product, start))(jax.random.key(3))[2], float)


def histogram_distance(values, grid, density):
    """Total variation between draws on a line and a density, over intervals of equal mass."""
    cumulative = np.cumsum(density) / density.sum()
    edges = np.interp(np.linspace(0, 1, 11)[1:-1], cumulative, grid)
    return 0.5 * np.abs(np.histogram(values, np.concatenate([[-1e9], edges, [1e9]]))[0] / len(values) - 0.1).sum()


@pytest.mark.slow
def test_a_product_of_mixtures_is_that_on_a_grid(monkeypatch):
    """Labels mix slowly: eight sweeps are 0.07 away in total variation."""
    monkeypatch.setattr(products, "SWEEPS", 60)
    points = jnp.asarray([[[-1.0], [0.2], [2.0]], [[-0.6], [1.0], [1.5]]])
    weights = jnp.asarray([[0.5, 0.2, 0.3], [0.3, 0.3, 0.4]])
    grid, sd = np.linspace(-5, 6, 2001), 0.5
    each = [sum(w * np.exp(-0.5 * ((grid - p) / sd) ** 2) for w, p in zip(weights[i], points[i, :, 0], strict=True)) for i in (0, 1)]
    values = drawn_product(dist.Normal(0.0, sd).expand([1]).to_event(1), points, weights)[:, 0]
    # By chance, 4000 draws in ten intervals are 0.02 off.
    assert histogram_distance(values, grid, np.asarray(each[0] * each[1], float)) < 0.04


def rings():
    """The angles of draws of a product of two rings, seen from the first centre, and their density on a grid."""
    # Equal particles have different normal distributions, each from a few draws.
    centres = jnp.repeat(jnp.asarray([[[0.0, 0.0]], [[3.0, 0.0]]]), 16, axis=1)
    values = drawn_product(log_ring, centres, jnp.full((2, 16), 1 / 16), draw_ring)
    axis = np.linspace(-9, 12, 601)
    x, y = np.meshgrid(axis, axis, indexing="ij")
    radii = [np.hypot(x, y), np.hypot(x - 3, y)]
    density = np.prod([np.exp(-0.5 * ((radius - FAR) / WIDTH) ** 2) / (radius + 1e-9) for radius in radii], axis=0)
    return values, axis, density


@pytest.mark.long
def test_a_product_of_rings_is_right_and_without_metropolis_hastings_it_is_not(monkeypatch):
    monkeypatch.setattr(products, "SWEEPS", 60)
    values, axis, density = rings()
    right = histogram_distance(np.abs(values[:, 1]), axis, np.where(axis > 0, density.sum(0), 0.0))
    monkeypatch.setattr(products, "_density", lambda given, x: 0 * x[..., 0])
    monkeypatch.setattr(products, "_log_factors", lambda graph, product, labels, x: 0 * x[..., 0])
    wrong = histogram_distance(np.abs(rings()[0][:, 1]), axis, np.where(axis > 0, density.sum(0), 0.0))
    assert right < 0.06
    assert wrong > 0.3


# -- strata -----------------------------------------------------------------------------------------------------------------------------------


def test_a_stratum_has_its_share_whatever_its_constant():
    rng = np.random.default_rng(0)
    raw = rng.normal(size=(2, 3, 50))
    shifted = raw + np.array([[0.0, 30.0, -40.0], [5.0, 0.0, 0.0]])[..., None]
    shares = jnp.asarray([[0.5, 0.2, 0.3], [0.5, 0.0, 0.5]])
    found = np.exp(np.asarray(jax.jit(stratified)(shifted.reshape(2, -1).astype(np.float32), shares), float)).reshape(2, 3, 50)
    np.testing.assert_allclose(found.sum(axis=2), shares, atol=1e-5)
    exact = np.exp(raw) / np.exp(raw).sum(axis=2, keepdims=True)
    np.testing.assert_allclose(found[0, 1], 0.2 * exact[0, 1], rtol=1e-3)


@pytest.mark.parametrize("empty", [-np.inf, np.nan])
def test_an_empty_stratum_leaves_its_share_to_the_others(empty):
    raw = np.array([[0.0] * 4 + [empty] * 4], np.float32)
    found = np.exp(np.asarray(jax.jit(stratified)(raw, jnp.asarray([[0.5, 0.5]])), float))
    np.testing.assert_allclose(found[0], [0.25] * 4 + [0.0] * 4, atol=1e-6)
