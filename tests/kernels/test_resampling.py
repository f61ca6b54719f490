"""Resampling: unbiased, and for the even schemes never more than one copy off."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from bayes_body.kernels.weights import resampler

SCHEMES = ["systematic", "stratified", "multinomial", "residual"]
WEIGHTS = np.array([0.02, 0.4, 0.0, 0.13, 0.25, 0.2])


def _copies(scheme, repeats=4000):
    resample = resampler(scheme)
    log_weights = jnp.log(jnp.asarray(WEIGHTS))
    chosen = jax.jit(jax.vmap(lambda k: resample(k, log_weights)))(jax.random.split(jax.random.key(1), repeats))
    return np.stack([np.bincount(row, minlength=len(WEIGHTS)) for row in np.asarray(chosen)])


@pytest.mark.parametrize("scheme", SCHEMES)
def test_expected_copies_are_proportional_to_the_weights(scheme):
    copies = _copies(scheme)
    mcse = copies.std(axis=0, ddof=1) / np.sqrt(len(copies)) + 1e-12
    assert (np.abs(copies.mean(axis=0) - len(WEIGHTS) * WEIGHTS) / mcse).max() < 4
    assert copies[:, 2].max() == 0


@pytest.mark.parametrize("scheme", ["systematic", "residual"])
def test_even_schemes_keep_the_whole_parts(scheme):
    copies = _copies(scheme, 500)
    assert (copies >= np.floor(len(WEIGHTS) * WEIGHTS)).all()


def test_unnormalised_and_huge_log_weights_are_the_same():
    resample, key = resampler("systematic"), jax.random.key(2)
    log_weights = jnp.log(jnp.asarray(WEIGHTS))
    assert (resample(key, log_weights) == resample(key, log_weights + 5000.0)).all()
