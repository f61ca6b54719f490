"""A prior with a potential: the kernels' posterior and evidence are those of prior times potential, by conjugacy. The potential is sharp and away.

Of independent draws of the transition almost none has weight: fewer than one in a thousand. The ladder of two rungs gets there.
"""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from closed_forms.targets import CENTRE, ROOT, conjugate

from bayes_body import kernels
from bayes_body.density.factor import Factor, Variable
from bayes_body.kernels.smc.tempered_smc import build_ladder_kernel

X = Variable("x")
PARTICLES = 1000
AWAY, PRECISION = np.array([3.0, -2.0, 1.5]), np.diag([300.0, 150.0, 400.0])
# What the image says, of a mixture of the three coordinates.
LOOK, NOISE, SEEN = np.array([0.5, -1.0, 0.3]), 0.05, 4.1


def _potential(values, _):
    off = values[X] - jnp.asarray(AWAY)
    return -0.5 * off @ jnp.asarray(PRECISION) @ off


def _seen(values, _):
    return -0.5 * ((jnp.asarray(LOOK) @ values[X] - SEEN) / NOISE) ** 2 - 0.5 * np.log(2 * np.pi * NOISE**2)


def _density(count=PARTICLES, side="prior"):
    density = conjugate(count).density
    factors = (Factor("joint", side, (X,), jax.tree_util.Partial(_potential)), Factor("seen", "likelihood", (X,), jax.tree_util.Partial(_seen)))
    return dataclasses.replace(density, factors=factors, data={})


def _exact():
    """Mean and covariance of the posterior, and log p(z) = log Z(1, 1) - log Z(1, 0)."""
    prior = np.linalg.inv(ROOT @ ROOT.T)
    with_potential = np.linalg.inv(prior + PRECISION)
    mean = with_potential @ (prior @ CENTRE + PRECISION @ AWAY)
    S = LOOK @ with_potential @ LOOK + NOISE**2
    gain = with_potential @ LOOK / S
    surprise = SEEN - LOOK @ mean
    evidence = -0.5 * (surprise**2 / S + np.log(2 * np.pi * S))
    return mean + gain * surprise, with_potential - np.outer(gain, LOOK @ with_potential), evidence


def test_independent_draws_have_next_to_no_weight():
    _, info = jax.jit(kernels.sir())(jax.random.key(0), _density().previous, _density())
    assert float(info.ess) < 5


@pytest.mark.long
def test_the_evidence_of_a_frozen_ladder_is_that_of_the_second_rung():
    density = _density()
    options = {"moves": 3}
    _, _, ladder = jax.jit(build_ladder_kernel(**options))(jax.random.key(1), density.previous, density)
    powers = np.asarray(ladder.potential_powers)
    used = np.isfinite(powers)
    assert (np.diff(powers[used]) >= 0).all() and powers[used][-1] == 1
    # The likelihood waits for the potential.
    assert (np.asarray(ladder.inverse_temperatures)[used][powers[used] < 1] == 0).all() and used.sum() > 6
    ladder = jax.tree.map(lambda leaf: leaf[: used.sum()], ladder)
    run = jax.jit(lambda key: build_ladder_kernel(ladder, **options)(key, density.previous, density)[:2])
    mean, _, evidence = _exact()
    found = [run(jax.random.key(k)) for k in range(2, 22)]
    logs = np.array([float(info.log_evidence) for _, info in found])
    # The ratio of two estimates: its bias is of the order of the variance.
    assert abs(logs.mean() - evidence) < 3 * logs.std(ddof=1) / np.sqrt(len(logs)) + logs.var(ddof=1)
    means = np.array([np.exp(after.log_weights) @ after.states["x"] for after, _ in found])
    off = np.abs(means.mean(axis=0) - mean) / (means.std(axis=0, ddof=1) / np.sqrt(len(means)))
    assert off.max() < 4
    assert all(float(info.ess) > 0.05 * PARTICLES for _, info in found)


@pytest.mark.long
def test_hmc_starts_on_the_ladder():
    density = _density(1)
    kernel = kernels.hmc(chains=4, burn_in=20, leapfrog_steps=8, step=0.3, starts=200, mass="curvature_matrix")
    after, info = jax.jit(kernel)(jax.random.key(3), _density(800).previous, density)
    mean, covariance, evidence = _exact()
    sd = np.sqrt(np.diagonal(covariance))
    draws = np.asarray(after.states["x"], float)
    assert np.abs(draws.mean(axis=0) - mean).max() < 4 * sd.max() / np.sqrt(100)
    assert np.allclose(draws.std(axis=0), sd, rtol=0.25)
    assert abs(float(info.log_evidence) - evidence) < 1.0


@pytest.mark.long
def test_a_potential_taken_for_a_likelihood_is_found_out():
    """A mutant: the evidence then contains the potential's normaliser."""
    density = _density(side="likelihood")
    _, info = jax.jit(kernels.tempered(moves=3))(jax.random.key(1), density.previous, density)
    assert abs(float(info.log_evidence) - _exact()[2]) > 5


@pytest.mark.slow
def test_a_mode_seeker_anneals_the_potential_too():
    density = _density()
    after, _ = jax.jit(kernels.annealed(layers=12))(jax.random.key(4), density.previous, density)
    best = np.exp(after.log_weights) @ after.states["x"]
    assert np.abs(best - _exact()[0]).max() < 0.3
