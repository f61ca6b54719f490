"""Weights in the log domain, degenerate ones included."""

import jax.numpy as jnp
import numpy as np
import pytest

from bayes_body.kernels.weights import effective_sample_size, normalise


def test_normalised_weights_sum_to_one():
    result = normalise(jnp.array([-1000.0, -1001.0, -999.5]))
    assert np.isclose(jnp.sum(jnp.exp(result.log_weights)), 1.0, atol=1e-6)
    assert np.isclose(result.log_sum, np.logaddexp.reduce([-1000.0, -1001.0, -999.5]), atol=1e-3)
    assert not result.lost


def test_a_whole_images_log_likelihood_leaves_the_weights_their_decimals():
    # Thousands of pixels: around -6000 the 32-bit numbers stand 1/2048 apart.
    levels = jnp.asarray(np.random.default_rng(0).normal(-6000, 3, 1000), jnp.float32)
    result = normalise(levels)
    assert np.isclose(np.sum(np.exp(np.asarray(result.log_weights, float))), 1, atol=1e-6)
    assert np.isclose(result.log_sum, np.logaddexp.reduce(np.asarray(levels, float)), atol=1e-3)


def test_nan_counts_as_weight_zero():
    result = normalise(jnp.array([0.0, jnp.nan, 0.0]))
    assert np.allclose(jnp.exp(result.log_weights), [0.5, 0.0, 0.5])
    assert not result.lost


@pytest.mark.parametrize("bad", [-jnp.inf, jnp.nan])
def test_nothing_left_is_said_and_leaves_equal_weights(bad):
    result = normalise(jnp.full(4, bad))
    assert result.lost
    assert np.allclose(jnp.exp(result.log_weights), 0.25)


@pytest.mark.parametrize(("weights", "size"), [([1, 1, 1, 1], 4.0), ([1, 0, 0, 0], 1.0), ([2, 2, 0, 0], 2.0), ([3, 1], 1.6)])
def test_effective_sample_size(weights, size):
    assert np.isclose(effective_sample_size(jnp.log(jnp.array(weights, float))), size, rtol=1e-5)
    assert np.isclose(effective_sample_size(jnp.log(jnp.array(weights, float)) - 3000.0), size, rtol=1e-3)
