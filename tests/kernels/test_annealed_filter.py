"""The annealed particle filter: the survival rate is met, modes are found, parameters cross over; and it does not pretend to be a sampler."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import numpyro.distributions as dist
import pytest

from bayes_body.density.density import Density
from bayes_body.density.factor import Factor, Particles, Transition, Variable
from bayes_body.density.spaces import SE3, Plate
from bayes_body.kernels.smc.annealed_filter import _cross_over, _Layer, _power_for_survival, build_kernel
from bayes_body.kernels.weights import effective_sample_size, resampler

X = Variable("x")


def _walk(previous):
    return {"x": dist.Normal(previous["x"], 1.0).to_event(1)}


def _noise(state, scale):
    return {"x": dist.Normal(state["x"], scale).to_event(1)}


WALK = Transition("walk", jax.tree_util.Partial(_walk), jax.tree_util.Partial(_noise))


def _two_peaks(values, data):
    """A broad low peak at 0, where the particles start, and a narrow high one at (2, 2, 2)."""
    x = values[X]
    broad, narrow = -jnp.sum(x**2) / 8, 3.0 - jnp.sum((x - 2) ** 2) / 0.3
    return jnp.logaddexp(broad, narrow)


def _problem(count):
    transition = Transition("walk", jax.tree_util.Partial(_walk), jax.tree_util.Partial(_noise))
    particles = Particles({"x": jnp.zeros((count, 3))}, jnp.full(count, -jnp.log(count)))
    return particles, Density(transition, (Factor("peaks", "likelihood", (X,), jax.tree_util.Partial(_two_peaks)),), {}, particles)


_power, _effective = jax.jit(_power_for_survival, static_argnums=2), jax.jit(effective_sample_size)


@pytest.mark.parametrize("rate", [0.2, 0.5, 0.8])
@pytest.mark.parametrize("spread", [1e-3, 1.0, 300.0])
def test_the_survival_rate_is_met(rate, spread):
    log_likelihood = spread * jax.random.gumbel(jax.random.key(3), (2000,))
    beta = _power(log_likelihood, jnp.zeros(2000), rate)
    assert np.isclose(_effective(beta * log_likelihood) / 2000, rate, atol=2e-3)


def test_the_survival_rate_counts_constraints_in():
    log_likelihood = jax.random.normal(jax.random.key(3), (2000,))
    constraint = jnp.where(jnp.arange(2000) < 300, -jnp.inf, 0.0)
    beta = _power(log_likelihood, constraint, 0.5)
    assert np.isclose(_effective(beta * log_likelihood + constraint) / 2000, 0.5, atol=2e-3)


_kernel = jax.jit(build_kernel(layers=8, survival_rate=0.5))


@pytest.mark.slow
def test_every_layer_survives_at_the_rate_and_powers_are_said():
    particles, density = _problem(2000)
    _, info = _kernel(jax.random.key(0), particles, density)
    assert np.allclose(info.survival_rate, 0.5, atol=2e-3)
    assert info.inverse_temperatures.shape == (8,) and (np.asarray(info.inverse_temperatures) > 0).all()
    assert np.isclose(info.ess, 1000, rtol=5e-3)


def test_it_finds_the_higher_mode_and_claims_no_evidence():
    particles, density = _problem(2000)
    after, info = _kernel(jax.random.key(1), particles, density)
    mean = np.exp(np.asarray(after.log_weights)) @ np.asarray(after.states["x"])
    assert np.linalg.norm(mean - 2) < 0.15
    assert np.isnan(info.log_evidence)


@pytest.mark.slow
def test_it_is_no_posterior_sampler():
    """Its spread around a mode is not the posterior's: on a Gaussian posterior of known width it is far off."""
    transition = Transition("walk", jax.tree_util.Partial(_walk), jax.tree_util.Partial(_noise))
    particles = Particles({"x": jnp.zeros((4000, 3))}, jnp.full(4000, -jnp.log(4000)))
    flat = jax.tree_util.Partial(lambda values, data: -0.5 * jnp.sum(values[X] ** 2) / 100.0)
    density = Density(transition, (Factor("flat", "likelihood", (X,), flat),), {}, particles)
    after, _ = jax.jit(build_kernel(layers=10))(jax.random.key(1), particles, density)
    weights, x = np.exp(np.asarray(after.log_weights)), np.asarray(after.states["x"])
    variance = weights @ (x - weights @ x) ** 2
    exact = 1 / (1 / 1.0 + 1 / 100.0)
    assert (variance < 0.25 * exact).all()


def test_crossover_takes_one_interval_of_a_second_parent():
    count = 400
    states = {"x": jnp.broadcast_to(jnp.arange(count, dtype=float)[:, None], (count, 7))}
    before = _Layer(states, jnp.full(count, -jnp.log(count)), jnp.arange(count), jnp.array(False))
    child = np.asarray(_cross_over(jax.random.key(0), states, before, resampler("systematic"), jnp.array(1.0), WALK)["x"])
    own = child == np.arange(count)[:, None]
    # What is foreign comes from one parent and is contiguous.
    for row, mine in zip(child, own, strict=True):
        foreign = np.flatnonzero(~mine)
        if foreign.size:
            assert np.unique(row[foreign]).size == 1
            assert (np.diff(foreign) == 1).all()
    assert 0.3 < (~own).any(axis=1).mean() < 1.0
    untouched = _cross_over(jax.random.key(0), states, before, resampler("systematic"), jnp.array(0.0), WALK)["x"]
    assert (untouched == states["x"]).all()


def test_crossover_takes_whole_parts():
    count = 400
    states = {"parts": jnp.broadcast_to(jnp.arange(count, dtype=float)[:, None, None], (count, 5, 7))}
    before = _Layer(states, jnp.full(count, -jnp.log(count)), jnp.arange(count), jnp.array(False))
    transition = replace(WALK, spaces=(("parts", Plate(tuple("abcde"), SE3())),))
    child = np.asarray(_cross_over(jax.random.key(0), states, before, resampler("systematic"), jnp.array(1.0), transition)["parts"])
    assert (child == child[:, :, :1]).all()
    own = child[:, :, 0] == np.arange(count)[:, None]
    assert all((np.diff(np.flatnonzero(~mine)) == 1).all() for mine in own)
    assert 0.3 < (~own).any(axis=1).mean() < 1.0 and own.any(axis=1).mean() > 0.5


def test_ancestors_lead_back_to_the_frame_before():
    """With noise far smaller than the gaps between the starting particles, each final particle lies beside its ancestor."""
    count = 50
    transition = Transition(
        "still",
        jax.tree_util.Partial(lambda previous: {"x": dist.Normal(previous["x"], 1e-3).to_event(1)}),
        jax.tree_util.Partial(lambda state, scale: {"x": dist.Normal(state["x"], 1e-3 * scale).to_event(1)}),
    )
    particles = Particles({"x": 10.0 * jnp.arange(count, dtype=float)[:, None]}, jnp.full(count, -jnp.log(count)))
    level = jax.tree_util.Partial(lambda values, data: jnp.sin(values[X][0]))
    density = Density(transition, (Factor("level", "likelihood", (X,), level),), {}, particles)
    after, info = jax.jit(build_kernel(layers=4, crossover_rate=0.0))(jax.random.key(0), particles, density)
    assert np.allclose(after.states["x"][:, 0], 10.0 * np.asarray(info.ancestors), atol=0.05)
