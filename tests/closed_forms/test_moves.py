"""What a Markov move hands back and what it refuses. That it keeps its target, test_invariance.py and test_tempered.py show."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from bayes_body.density.tempering import LogTerms
from bayes_body.kernels.smc.moves import hmc, random_walk

MOVES = {"hmc": hmc(6), "random_walk": random_walk()}
START = {"a": jnp.array([0.5, -0.2]), "b": jnp.array([1.0])}


def target(position):
    """A skewed likelihood and a normal prior."""
    likelihood = -jnp.exp(position["a"][0]) + position["a"][1] * position["b"][0]
    return likelihood - 0.5 * sum(jnp.sum(x * x) for x in position.values()), LogTerms(likelihood, jnp.zeros(()))


def walled(position):
    log_density, likelihood = target(position)
    return jnp.where(position["b"][0] > 0.9, log_density, -jnp.inf), likelihood


def broken(position):
    log_density, likelihood = target(position)
    return jnp.where(position["b"][0] == 1, log_density, jnp.nan), likelihood


def moved(name, target, scale, count=400):
    step = MOVES[name].step
    return jax.jit(jax.vmap(lambda key: step(key, START, target, jnp.asarray(scale))))(jax.random.split(jax.random.key(3), count))


@pytest.mark.parametrize("name", MOVES)
def test_the_likelihood_is_that_of_where_it_ended(name):
    found = moved(name, target, 0.7)
    stayed = np.asarray(found.position["b"][:, 0]) == 1
    assert 0 < stayed.mean() < 1
    expected = jax.jit(jax.vmap(lambda p: target(p)[1].likelihood))(found.position)
    np.testing.assert_allclose(np.asarray(found.terms.likelihood), np.asarray(expected), rtol=1e-5, atol=1e-5)
    assert stayed.mean() == pytest.approx(1 - float(jnp.mean(found.acceptance_rate)), abs=0.08)


@pytest.mark.parametrize("name", MOVES)
def test_a_wall_is_not_crossed(name):
    found = moved(name, walled, 0.7)
    assert (np.asarray(found.position["b"]) > 0.9).all()
    assert (np.asarray(found.position["b"][:, 0]) != 1).any()


@pytest.mark.parametrize("name", MOVES)
def test_what_is_not_a_number_is_refused(name):
    found = moved(name, broken, 0.7)
    assert (np.asarray(found.acceptance_rate) == 0).all()
    assert all((np.asarray(found.position[key]) == np.asarray(START[key])).all() for key in START)
    np.testing.assert_allclose(found.terms.likelihood, target(START)[1].likelihood, rtol=1e-6)


def test_the_error_of_a_trajectory_falls_with_the_square_of_its_step():
    """The leapfrog's order: a tenth of the step, a hundredth of the energy's error."""
    key, errors = jax.random.split(jax.random.key(5), 2000), []
    for leapfrog_steps, scale in ((4, 0.2), (40, 0.02)):
        step = hmc(leapfrog_steps).step
        rates = jax.jit(jax.vmap(lambda k, step=step, scale=scale: step(k, START, target, jnp.asarray(scale)).acceptance_rate))(key)
        errors.append(1 - float(jnp.mean(rates)))
    assert 0.003 < errors[1] / errors[0] < 0.03
