"""Particle Gibbs against the exact smoothers of linear Gaussian processes of first and of second order."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from closed_forms import conditional_smc
from closed_forms.conditional_smc import particle_gibbs
from closed_forms.processes import FIRST, SECOND, SEEN, distance

from bayes_body.base.errors import InputError

KEYS, BEFORE, PARTICLES, SWEEPS, BURN_IN = 16, 200, 12, 400, 50
FAULT = "standard errors from the exact smoother"


def check(process, change=lambda transition: transition, particles=PARTICLES):
    """Means and covariances of all frames together within four standard errors over the keys."""
    frames = process.frames()
    frames = dataclasses.replace(frames, transition=change(frames.transition))

    def run(key):
        start_key, chain_key = jax.random.split(key)
        path = {"x": jnp.zeros((len(SEEN), 2))}
        # Not the compiled form: it would keep a change of the module for later tests.
        return particle_gibbs.__wrapped__(chain_key, path, frames, process.start(start_key, BEFORE), particles, SWEEPS).states["x"]

    draws = np.asarray(jax.jit(jax.vmap(run))(jax.random.split(jax.random.key(0), KEYS)), float)[:, BURN_IN:].reshape(KEYS, -1, 2 * len(SEEN))
    runs = draws.mean(axis=1), np.array([np.cov(each.T) for each in draws])
    for name, given, found in zip(("mean", "covariance"), process.exact(), runs, strict=True):
        assert distance(given, found) < 4, f"{name}: {distance(given, found):.1f} {FAULT}"


@pytest.mark.slow
@pytest.mark.parametrize("process", [pytest.param(FIRST, id="first order"), pytest.param(SECOND, id="second order")])
def test_the_paths_are_those_of_the_exact_smoother(process):
    check(process)


@pytest.mark.long
def test_two_particles_are_enough():
    check(FIRST, particles=2)


@pytest.mark.slow
def test_a_sweep_that_ignores_the_second_frame_is_found_out():
    with pytest.raises(AssertionError, match=FAULT):
        check(SECOND, lambda transition: dataclasses.replace(transition, memory=1))


@pytest.mark.slow
def test_a_sweep_that_forgets_the_weights_of_the_past_is_found_out(monkeypatch):
    def forgetful(particles, ahead, after, transition):
        return weights(particles._replace(log_weights=jnp.zeros_like(particles.log_weights)), ahead, after, transition)

    weights = conditional_smc.ancestor_log_weights
    monkeypatch.setattr(conditional_smc, "ancestor_log_weights", forgetful)
    with pytest.raises(AssertionError, match=FAULT):
        check(FIRST)


def test_one_particle_is_refused():
    with pytest.raises(InputError, match="particles: 1; expected a whole number from 2 up"):
        particle_gibbs(jax.random.key(0), {"x": jnp.zeros((len(SEEN), 2))}, FIRST.frames(), FIRST.start(jax.random.key(0)), 1, 1)
