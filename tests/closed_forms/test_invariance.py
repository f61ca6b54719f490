"""The Markov moves that kernels are made of keep the posterior exactly; mutants do not. Each is compiled once, with its faults as arguments."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from workshop.calibration import toys

from bayes_body.base.registry import find, names
from bayes_body.density.coordinates import Coordinates
from bayes_body.density.extended import Extended
from bayes_body.kernels.markov_moves import iterated_sir
from bayes_body.workshop.calibration import invariance, looks
from bayes_body.workshop.calibration.check import markov_move

REPLICATIONS = 1000
LIMIT = 0.05 / 5
# A check with two tests would fail at its first look.
FAILS = looks.limits(0, 2, 5).fails


def least_p(found):
    return invariance.p_values(found.after, found.other).min()


def replications(run, seed, *faults):
    keys = jax.random.split(jax.random.key(seed), REPLICATIONS)
    return jax.tree.map(np.asarray, run(keys, *(jnp.float32(fault) for fault in faults)))


@pytest.fixture(scope="module")
def iterated():
    """Against three rivals only: exact all the same. `power` of the weights."""
    move = iterated_sir(4)

    @jax.jit
    def run(keys, power):
        def faulty(key, state, ancestor, previous, density):
            return move(key, state, ancestor, previous, toys.powered(density, power))

        return jax.lax.map(invariance.replicate(toys.skewed(wall=True), faulty, 20), keys)

    return lambda power=1.0: replications(run, 0, power)


@pytest.mark.long
def test_iterated_resampling_keeps_the_posterior(iterated):
    found = iterated()
    assert least_p(found) > LIMIT
    assert found.moved.mean() > 0.9 and not found.refused.any()


@pytest.mark.long
@pytest.mark.parametrize("power", [-1.0, 0.5, 0.0], ids=["sign", "root of the weights", "weights forgotten"])
def test_a_faulty_resampling_is_found_out(iterated, power):
    assert least_p(iterated(power)) <= FAILS


@pytest.fixture(scope="module")
def walk():
    """`jacobian` and `likelihood` scale these terms of the density that the walk walks on."""
    honest, volume, move = Extended.log_density, Coordinates.log_determinant, markov_move("tempered", find("kernel", "tempered").options())

    @jax.jit
    def run(keys, jacobian, likelihood):
        def log_density(self, ancestor, position, inverse_temperature, potential_power):
            return honest(self, ancestor, position, likelihood * inverse_temperature, potential_power)

        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(Extended, "log_density", log_density)
            patch.setattr(Coordinates, "log_determinant", lambda self, position: jacobian * volume(self, position))
            return jax.lax.map(invariance.replicate(toys.skewed(wall=True), move, 3), keys)

    return lambda jacobian=1.0, likelihood=1.0: replications(run, 1, jacobian, likelihood)


@pytest.mark.slow
def test_the_walk_keeps_the_posterior(walk):
    found = walk()
    assert least_p(found) > LIMIT
    assert found.moved.mean() > 0.9


@pytest.mark.slow
@pytest.mark.parametrize("fault", [{"jacobian": 0.0}, {"likelihood": -1.0}, {"likelihood": 0.5}], ids=["Jacobian dropped", "sign", "half tempered"])
def test_a_faulty_walk_is_found_out(walk, fault):
    assert least_p(walk(**fault)) <= FAILS


@pytest.mark.long
def test_an_ancestor_drawn_without_its_weight_is_found_out(monkeypatch):
    honest = Extended.choose_ancestor

    def flat(self, key, *arguments):
        even = self._replace(cumulative_weights=jnp.arange(1.0, self.cumulative_weights.shape[0] + 1))
        return honest(even, key, *arguments)

    monkeypatch.setattr(Extended, "choose_ancestor", flat)
    move = markov_move("tempered", find("kernel", "tempered").options())
    run = jax.jit(lambda keys: jax.lax.map(invariance.replicate(toys.skewed(), move, 3), keys))
    assert least_p(replications(run, 2)) <= FAILS


@pytest.fixture(scope="module")
def trajectories():
    """Hamiltonian Monte Carlo on the marginal view; `jacobian` scales the log-determinant."""
    options = find("kernel", "hmc").options(leapfrog_steps=6, step=0.8)
    move, honest = markov_move("hmc", options), Coordinates.log_determinant

    @jax.jit
    def run(keys, jacobian):
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(Coordinates, "log_determinant", lambda self, position: jacobian * honest(self, position))
            return jax.lax.map(invariance.replicate(toys.skewed(wall=True), move, 2), keys)

    return lambda jacobian=1.0: replications(run, 3, jacobian)


@pytest.mark.long
def test_trajectories_on_the_marginal_view_keep_the_posterior(trajectories):
    found = trajectories()
    assert least_p(found) > LIMIT
    assert found.moved.mean() > 0.9


@pytest.mark.long
def test_trajectories_without_the_log_determinant_are_found_out(trajectories):
    assert least_p(trajectories(jacobian=0.0)) <= FAILS


def test_a_mode_seeker_has_no_such_move():
    moves = {kind: markov_move(kind, find("kernel", kind).options()) for kind in names("kernel")}
    assert moves["annealed"] is None
    assert all(moves[kind] is not None for kind in ("hmc", "sir", "tempered"))
