"""The evidence of a window by bridge sampling, against the exact one of linear Gaussian processes, and of a distribution that is no Gaussian."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from closed_forms.processes import BEFORE, FIRST, SECOND, SEEN
from closed_forms.test_window import _paths, _target

from bayes_body.kernels.paths.window import WindowDraws, sample_window
from bayes_body.kernels.paths.window_evidence import bridged, window_evidence

FRAMES = len(SEEN)


def _exact(process):
    """The log-evidence of all frames after the origin."""
    return process._given(np.zeros(2), np.zeros((2, 2)))[2] - 0.5 * SEEN.size * np.log(2 * np.pi)


def _exact_draws(process, target, count):
    """Draws of the exact posterior, in the form of those of chains."""
    mean, covariance = process.exact(np.zeros((2, 2)))
    rng = np.random.default_rng(0)
    x = (mean + rng.standard_normal((4 * count, len(mean))) @ np.linalg.cholesky(covariance).T).reshape(4, count, FRAMES, 2)
    earlier = np.concatenate([np.zeros((4, count, 1, 2)), x[:, :, :-1]], axis=2)
    states = {name: jnp.asarray(values) for name, values in ({"x": x} | ({BEFORE: earlier} if process.memory == 2 else {})).items()}
    positions = jax.jit(jax.vmap(jax.vmap(target.position)))(states)
    nothing = jnp.zeros((4, count))
    log_density = jax.jit(jax.vmap(jax.vmap(target)))(positions)
    return WindowDraws(states, positions["x"], nothing, nothing, nothing > 1, nothing.astype(int), nothing, log_density, nothing[:, 0], nothing[0, 0])


@pytest.mark.parametrize("process", [pytest.param(FIRST, id="first order"), pytest.param(SECOND, id="second order")])
def test_the_evidence_of_a_window_is_that_of_the_kalman_filter(process):
    target = _target(process)
    found = window_evidence(jax.random.key(1), target, _exact_draws(process, target, 400))
    assert 0 < found.error < 0.1 and abs(found.value - _exact(process)) < 4 * found.error


@pytest.mark.slow
def test_the_evidence_from_chains_of_nuts_is_exact_within_its_error():
    target = _target(FIRST)
    draws = sample_window(jax.random.key(3), target, _paths(FIRST, 40, 2.0), warm_up=200, draws=400)
    found = window_evidence(jax.random.key(1), target, draws)
    assert 0 < found.error < 0.1 and abs(found.value - _exact(FIRST)) < 4 * found.error


def test_the_error_is_that_of_repeated_bridges():
    """A skewed posterior: the logarithm of a gamma variable, whose evidence is known, bridged by a normal distribution."""
    rng, shape, errors, values = np.random.default_rng(0), 3.0, [], []
    for _ in range(200):
        draws, normal = np.log(rng.gamma(shape, size=(2, 300))), rng.normal(0.9, 0.7, 600)

        def log_ratio(y):
            return shape * y - np.exp(y) + 0.5 * ((y - 0.9) / 0.7) ** 2 + np.log(0.7 * np.sqrt(2 * np.pi))

        found = bridged(log_ratio(draws), log_ratio(normal))
        errors.append(found.error)
        values.append(found.value)
    assert abs(np.mean(values) - np.log(2.0)) < 4 * np.std(values) / np.sqrt(len(values))
    assert 0.8 < np.median(errors) / np.std(values) < 1.25


def test_a_posterior_that_no_normal_draw_reaches_has_no_evidence():
    found = bridged(np.zeros((2, 20)), np.full(40, -np.inf))
    assert found.value == -np.inf and found.error == np.inf
    few = window_evidence(jax.random.key(0), _target(FIRST), _exact_draws(FIRST, _target(FIRST), 8))
    assert np.isnan(few.value)
