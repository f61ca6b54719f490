"""Batches spread over devices give what a plain vmap gives."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from bayes_body.kernels.batching import over_particles


def _both(pair, shared):
    x, y = pair
    return {"sum": jnp.sum(x) * shared + y, "x": jnp.sin(x)}


@pytest.mark.parametrize("count", [1, 32, 33, 64, 100])
@pytest.mark.parametrize("batch", [8, 32])
def test_it_equals_vmap(count, batch):
    x = jax.random.normal(jax.random.key(0), (count, 3))
    y = jnp.arange(count, dtype=float)
    got = jax.jit(lambda p, s: over_particles(_both, p, s, batch))((x, y), jnp.array(2.0))
    wanted = jax.jit(jax.vmap(_both, (0, None)))((x, y), jnp.array(2.0))
    assert jax.tree.all(jax.tree.map(lambda a, b: np.allclose(a, b, atol=1e-6), got, wanted))


def test_it_is_differentiable():
    x, y = jax.random.normal(jax.random.key(0), (70, 3)), jnp.zeros(70)
    gradient = jax.jit(jax.grad(lambda v: jnp.sum(over_particles(_both, (v, y), jnp.array(2.0))["x"])))(x)
    assert np.allclose(gradient, jnp.cos(x), atol=1e-6)


def test_a_common_key_draws_the_same_for_all():
    """On several devices too, where JAX refuses it for parameters that differ between them."""
    a = jnp.linspace(1.0, 9.0, 70)
    got = jax.jit(lambda a, key: over_particles(lambda a, key: jax.random.gamma(key, a), a, key, 32))(a, jax.random.key(3))
    assert np.allclose(got, jax.vmap(lambda a: jax.random.gamma(jax.random.key(3), a))(a), rtol=1e-5)
