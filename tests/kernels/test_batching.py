"""Batches spread over devices give what a plain vmap gives."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from bayes_body.kernels import batching
from bayes_body.kernels.batching import over_particles
from bayes_body.kernels.working_memory import work_bytes


def _both(pair, shared):
    x, y, *rest = pair
    return {"sum": jnp.sum(x) * shared + y, "x": jnp.sin(x), "without entries": rest}


@pytest.mark.parametrize("count", [1, 32, 33, 64, 100])
@pytest.mark.parametrize("batch", [8, 32])
def test_it_equals_vmap(count, batch):
    x = jax.random.normal(jax.random.key(0), (count, 3))
    y = jnp.arange(count, dtype=float)
    empty = jnp.zeros((count, 0, 2))
    got = jax.jit(lambda p, s: over_particles(_both, p, s, batch))((x, y, empty), jnp.array(2.0))
    wanted = jax.jit(jax.vmap(_both, (0, None)))((x, y, empty), jnp.array(2.0))
    assert got["without entries"][0].shape == empty.shape
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


def _gradient(x, shared):
    return jax.grad(lambda v: jnp.sum(jnp.sin(v @ shared) ** 2))(x)


def _programs(memory, count=100, runs=1):
    """The number of particles that `over_particles` computes at once on an accelerator with that memory, and what it returns."""
    x, shared, sizes = jax.random.normal(jax.random.key(0), (count, 3)), jnp.eye(3) + 0.1, []

    def record(count, bytes_of_one, memory):
        sizes.append(by_memory(count, bytes_of_one, memory))
        return sizes[-1]

    by_memory = batching._batch_by_memory
    with pytest.MonkeyPatch.context() as patch, batching.assumed_accelerator(memory), batching.several_runs(runs):
        patch.setattr(batching, "_batch_by_memory", record)
        return sizes, jax.jit(lambda x, shared: over_particles(_gradient, x, shared))(x, shared), jax.vmap(_gradient, (0, None))(x, shared)


def test_on_an_accelerator_the_memory_decides_how_many_are_computed_at_once():
    need = work_bytes(_gradient, jnp.zeros((1, 3)), jnp.eye(3))
    room = 10 * need / batching.WORK_SHARE
    for memory, runs, expected in ((1e12, 1, 100), (room, 1, 10), (room, 2, 5), (room * 3.5, 1, 34), (1.0, 1, 1)):
        (size,), got, wanted = _programs(memory, runs=runs)
        assert size == expected
        assert np.allclose(got, wanted, atol=1e-6)


def test_many_particles_are_shared_by_the_accelerators(monkeypatch):
    assert len(jax.devices()) == 2
    with batching.assumed_accelerator(1e12):
        assert len(batching._devices(batching.SHARED_FROM, 32)) == 1 and len(batching._devices(batching.SHARED_FROM + 1, 32)) == 2
    monkeypatch.setattr(batching, "SHARED_FROM", 99)
    (size,), got, wanted = _programs(1e12)
    assert size == 50 and len(got.sharding.device_set) == 2
    assert np.allclose(got, wanted, atol=1e-6)


def test_the_work_of_a_particle_is_what_depends_on_it():
    image, x = jnp.zeros((500, 500)), jnp.zeros((7, 3))
    # The particle, 50 numbers and their sine.
    assert work_bytes(lambda x, image: jnp.sin(jnp.tile(x[:1], 50)), x, image) == 4 * (3 + 50 + 50)
    assert work_bytes(lambda x, image: jnp.sum(jnp.sin(image)) * x[0], x, image) < 100
    # Within a function and a loop, too. What a loop carries is counted from its first turn on.
    inner = jax.jit(lambda image, x: jnp.sum(jnp.tile(x, 100)) + image[0, 0])
    assert 4 * 300 < work_bytes(lambda x, image: inner(image, x), x, image) < 4 * 400
    looped = work_bytes(lambda x, image: jax.lax.fori_loop(0, 9, lambda _, total: total + jnp.tile(x, 100), jnp.zeros(300)), x, image)
    assert 4 * 600 < looped < 4 * 2500
