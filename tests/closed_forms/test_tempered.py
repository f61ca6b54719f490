"""Tempered SMC against closed forms: unbiased evidence, posterior means, the prior at temperature zero; and mutants that these tests detect."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from closed_forms.targets import LOW, SD, START, conjugate, point_mass, skewed
from scipy import stats

from bayes_body.density.coordinates import Coordinates
from bayes_body.density.extended import Extended
from bayes_body.kernels.smc import tempered_smc
from bayes_body.kernels.smc.tempered_smc import build_kernel, build_ladder_kernel

PARTICLES, RUNS = 240, 240
KERNELS = {
    "hmc": {},
    "random_walk": {"move": "random_walk", "moves": 5},
    "waste_free": {"waste_free": True, "moves": 3},
}


def _frozen(density, particles, options):
    """The kernel with the ladder of a pilot run."""
    _, _, ladder = jax.jit(build_ladder_kernel(**options))(jax.random.key(7), particles, density)
    stages = int(np.isfinite(ladder.inverse_temperatures).sum())
    assert stages > 2 and np.isclose(ladder.inverse_temperatures[stages - 1], 1)
    return build_kernel(frozen_at=jax.tree.map(lambda leaf: leaf[:stages], ladder), **options)


def _check(target, options, kernel=None):
    """Evidence and mean of many runs, against the exact ones."""
    previous = target.density.previous
    kernel = kernel or _frozen(target.density, previous, options)

    def once(key):
        particles, info = kernel(key, previous, target.density)
        return info.log_evidence, jnp.exp(particles.log_weights) @ particles.states["x"]

    log_evidence, means = (
        np.asarray(out, float) for out in jax.jit(lambda keys: jax.lax.map(once, keys))(jax.random.split(jax.random.key(11), RUNS))
    )
    assert log_evidence.std() <= 0.5
    ratios = np.exp(log_evidence - target.log_evidence)
    off = (ratios.mean() - 1) / (ratios.std(ddof=1) / np.sqrt(RUNS))
    assert abs(off) < 3, f"evidence: {off:.1f} standard errors from the exact one"
    off = np.abs(means.mean(axis=0) - target.mean) / (means.std(axis=0, ddof=1) / np.sqrt(RUNS))
    assert off.max() < 4, f"mean: {off.max():.1f} standard errors from the exact one"


# Compilation takes most of these tests' time.
EACH_KERNEL = [pytest.param(options, id=name, marks=[] if name == "hmc" else pytest.mark.long) for name, options in KERNELS.items()]


@pytest.mark.slow
@pytest.mark.parametrize("options", EACH_KERNEL)
@pytest.mark.parametrize("make", [conjugate, skewed])
def test_evidence_and_mean_are_unbiased(make, options):
    _check(make(PARTICLES), options)


@pytest.mark.long
def test_evidence_of_a_state_space_model_is_unbiased(linear_gaussian, observations):
    """Over three frames, each with the ladder of the pilot's frame."""
    ys = observations[:3]
    exact = linear_gaussian.kalman(ys)[2].sum()
    pilot, kernels = linear_gaussian.start(jax.random.key(3), PARTICLES), []
    for frame, y in enumerate(ys):
        kernels.append(_frozen(linear_gaussian.density(y, pilot), pilot, {}))
        pilot, _ = jax.jit(kernels[-1])(jax.random.fold_in(jax.random.key(4), frame), pilot, linear_gaussian.density(y, pilot))

    def once(key):
        particles, total = linear_gaussian.start(jax.random.fold_in(key, 99), PARTICLES), 0.0
        for frame, (kernel, y) in enumerate(zip(kernels, ys, strict=True)):
            particles, info = kernel(jax.random.fold_in(key, frame), particles, linear_gaussian.density(y, particles))
            total += info.log_evidence
        return total

    log_evidence = np.asarray(jax.jit(lambda keys: jax.lax.map(once, keys))(jax.random.split(jax.random.key(5), RUNS)), float)
    ratios = np.exp(log_evidence - exact)
    assert log_evidence.std() <= 0.5
    assert abs(ratios.mean() - 1) < 3 * ratios.std(ddof=1) / np.sqrt(RUNS)


@pytest.mark.long
@pytest.mark.parametrize("options", EACH_KERNEL)
def test_at_temperature_zero_it_is_the_prior_in_distribution(options):
    """After three stages of moves at temperature zero the particles still are the prediction under its constraint."""
    target = skewed(PARTICLES)
    _, _, ladder = jax.jit(build_ladder_kernel(**options))(jax.random.key(7), target.density.previous, target.density)
    level = jax.tree.map(lambda leaf: jnp.stack([leaf[1]] * 4), ladder)._replace(inverse_temperatures=jnp.zeros(4))
    kernel = build_kernel(frozen_at=level, **options)

    def one(key):
        particles, info = kernel(key, target.density.previous, target.density)
        # One a run: the particles of a run are not independent of each other.
        return particles.states["x"][17], info.acceptance_rate

    draws, rates = (np.asarray(out, float) for out in jax.jit(lambda keys: jax.lax.map(one, keys))(jax.random.split(jax.random.key(13), 400)))
    assert np.nanmean(rates) > 0.1
    # The first coordinate is behind no wall: the truncated normal itself.
    side = (LOW[0] - START[0]) / SD[0], (2.0 - START[0]) / SD[0]
    assert stats.kstest(draws[:, 0], stats.truncnorm(*side, START[0], SD[0]).cdf).pvalue > 1e-3
    # The second by quadrature.
    grid = np.linspace(-1, 1, 20_001)
    mass = np.exp(-0.5 * ((grid - START[1]) / SD[1]) ** 2 - 0.5 * (np.maximum(grid - 0.25, 0) / 0.15) ** 2)
    assert stats.kstest(draws[:, 1], lambda x: np.interp(x, grid, np.cumsum(mass) / mass.sum())).pvalue > 1e-3


@pytest.mark.long
def test_ancestors_are_drawn_from_their_posterior(linear_gaussian):
    """p(i | everything), by Gaussian algebra, against the weighted shares of the final particles."""
    previous = linear_gaussian.start(jax.random.key(1), 6)._replace(log_weights=jax.nn.log_softmax(jnp.array([0.0, 1.0, -1.0, 0.5, 0.0, 2.0])))
    y = np.array([0.8])
    prediction = np.asarray(previous.states["x"]) @ linear_gaussian.A.T @ linear_gaussian.H.T
    sd = np.sqrt((linear_gaussian.H @ linear_gaussian.Q_root @ linear_gaussian.Q_root.T @ linear_gaussian.H.T)[0, 0] + linear_gaussian.R_sd**2)
    exact = np.exp(np.asarray(previous.log_weights)) * stats.norm.pdf(y[0], prediction[:, 0], sd)
    many = jax.tree.map(lambda leaf: jnp.repeat(leaf, 100, axis=0), previous)
    many = many._replace(log_weights=jax.nn.log_softmax(many.log_weights))
    kernel = jax.jit(build_kernel())

    def shares(key):
        particles, info = kernel(key, many, linear_gaussian.density(y, many))
        return np.bincount(np.asarray(info.ancestors) // 100, np.exp(np.asarray(particles.log_weights)), 6)

    found = np.array([shares(jax.random.key(k)) for k in range(30)])
    off = np.abs(found.mean(axis=0) - exact / exact.sum()) / (found.std(axis=0, ddof=1) / np.sqrt(30))
    assert off.max() < 4


# -- mutants ----------------------------------------------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.long
def test_a_wrong_sign_of_the_weights_is_found_out(monkeypatch):
    target, honest = skewed(PARTICLES), tempered_smc.feynman_kac_step
    kernel = _frozen(target.density, target.density.previous, {})

    def negated(key, particles, log_weights, move, log_potential, resample, resampled):
        return honest(key, particles, log_weights, move, lambda moved: -log_potential(moved), resample, resampled)

    monkeypatch.setattr(tempered_smc, "feynman_kac_step", negated)
    with pytest.raises(AssertionError):
        _check(target, {}, kernel)


@pytest.mark.long
def test_weights_dropped_at_the_last_stage_are_found_out(monkeypatch):
    target = skewed(PARTICLES)
    kernel = _frozen(target.density, target.density.previous, {"final_stages": 0})

    def forgetful(key, particles, density):
        after, info = kernel(key, particles, density)
        return after._replace(log_weights=jnp.full(PARTICLES, -jnp.log(PARTICLES))), info

    with pytest.raises(AssertionError, match="mean: "):
        _check(target, {}, forgetful)


@pytest.mark.long
def test_a_tempered_constraint_is_found_out(monkeypatch):
    target, honest = skewed(PARTICLES), Extended.log_density
    kernel = _frozen(target.density, target.density.previous, {})

    def tempered_wall(self, ancestor, position, inverse_temperature, potential_power):
        wall = self.density.log_constraint(self.state(ancestor, position), self.density.ancestor(ancestor))
        log_density, log_likelihood = honest(self, ancestor, position, inverse_temperature, potential_power)
        return log_density + (inverse_temperature - 1) * wall, log_likelihood

    monkeypatch.setattr(Extended, "log_density", tempered_wall)
    with pytest.raises(AssertionError, match="standard errors from the exact one"):
        _check(target, {}, kernel)


@pytest.mark.long
def test_a_dropped_jacobian_is_found_out(monkeypatch):
    target = skewed(PARTICLES)
    kernel = _frozen(target.density, target.density.previous, {})
    monkeypatch.setattr(Coordinates, "log_determinant", lambda self, position: jnp.zeros(()))
    with pytest.raises(AssertionError, match="standard errors from the exact one"):
        _check(target, {}, kernel)


@pytest.mark.long
def test_a_likelihood_without_a_gradient_is_refused_to_hmc():
    density = skewed(PARTICLES).density
    blind = dataclasses.replace(density, factors=tuple(dataclasses.replace(factor, has_gradient=False) for factor in density.factors))
    with pytest.raises(ValueError, match="'y' has no gradient; expected a likelihood with a gradient, for move = \"hmc\""):
        build_kernel()(jax.random.key(0), density.previous, blind)
    jax.jit(build_kernel(move="random_walk"))(jax.random.key(0), density.previous, blind)


def test_options_are_checked():
    with pytest.raises(ValueError, match="moves = 0; expected a number greater than or equal to 1"):
        build_kernel(moves=0)
    with pytest.raises(ValueError, match=r"tempered\(waste_free=true\): 100 particles with chains of 2 moves; expected a multiple of 3 particles"):
        build_kernel(waste_free=True)(jax.random.key(0), point_mass(START, 100), skewed(100).density)
