"""Lengths of trajectories: within their range, evenly spread over it, and alike in all chains."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from bayes_body.kernels.hmc.hamiltonian import Schedule, leapfrog_steps, run_chain


def _schedule(steps, jitter):
    return Schedule(draws=50, burn_in=0, thinning=1, leapfrog_steps=steps, jitter=jitter, sampler="hmc", target_acceptance=0.0)


def _lengths(schedule, number):
    return np.asarray(jax.jit(jax.vmap(lambda index: leapfrog_steps(schedule, index)))(jnp.arange(number)))


@pytest.mark.parametrize(("steps", "jitter", "least", "most"), [(15, 0.3, 10, 20), (20, 0.2, 16, 24), (1, 0.5, 1, 2), (7, 1.0, 1, 14)])
def test_lengths_fill_their_range_evenly(steps, jitter, least, most):
    lengths = _lengths(_schedule(steps, jitter), 6000)
    found, counts = np.unique(lengths, return_counts=True)
    assert found.tolist() == list(range(least, most + 1))
    # Of random lengths the counts would differ by tens.
    assert np.ptp(counts) <= 6
    # And so do the first few.
    assert np.ptp(lengths[:4]) >= (most - least) // 2


def test_without_jitter_all_are_of_one_length():
    assert set(_lengths(_schedule(12, 0.0), 500)) == {12}


def test_chains_side_by_side_take_as_many_steps_each():
    def normal(position):
        return -0.5 * jnp.sum(position["x"] ** 2)

    def run(key):
        return run_chain(key, {"x": jnp.zeros(2)}, normal, jnp.asarray(0.3), jnp.ones(2), _schedule(6, 0.5))

    chains = jax.jit(jax.vmap(run))(jax.random.split(jax.random.key(0), 3))
    assert np.array_equal(chains.gradients, np.full(3, 1 + _lengths(_schedule(6, 0.5), 50).sum()))
    assert len(np.unique(np.asarray(chains.positions["x"][:, -1, 0]))) == 3
