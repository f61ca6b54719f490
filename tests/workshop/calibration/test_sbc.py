"""Ranks: an honest kernel's are uniform, a mutant's are not; each kernel is compiled once, with its faults as arguments."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from workshop.calibration import toys

from bayes_body import kernels
from bayes_body.density.coordinates import Coordinates
from bayes_body.kernels.smc import tempered_smc
from bayes_body.model.build import build_model
from bayes_body.workshop.calibration import bands, looks, sbc
from bayes_body.workshop.calibration.problem import point_mass, problem_of
from bayes_body.workshop.calibration.verdict import coverage

REPLICATIONS, BINS, SEED = 200, 20, 100
LIMIT = 0.05 / 3
# A check with two tests would fail at its first look.
FAILS = looks.limits(0, 2, 3).fails


def ranks(one, seed=SEED, count=REPLICATIONS):
    keys = jax.random.split(jax.random.key(seed), count)
    return jax.tree.map(np.asarray, jax.jit(lambda keys: jax.lax.map(one, keys))(keys))


def least_p(found):
    return bands.p_values(bands.rank_counts(found.ranks, BINS)).min()


# -- sampling importance resampling -----------------------------------------------------------------------------------------------------------


# Replications of these kernels run for longer than they compile.
@pytest.fixture(scope="module")
def sir(optimised):
    """`sir(power, forgets)`: its replications, its weights to a power and perhaps forgotten at the end."""

    @jax.jit
    def run(keys, power, forgets):
        def kernel(key, particles, density):
            after, info = kernels.sir()(key, particles, toys.powered(density, power))
            equal = jnp.full_like(after.log_weights, -jnp.log(after.log_weights.shape[0]))
            return after._replace(log_weights=jnp.where(forgets, equal, after.log_weights)), info

        return jax.lax.map(sbc.replicate(toys.skewed(wall=True), kernel, 5000, bins=BINS), keys)

    def call(power=1.0, forgets=False):
        return jax.tree.map(np.asarray, run(jax.random.split(jax.random.key(SEED), REPLICATIONS), jnp.float32(power), forgets))

    return call


@pytest.mark.slow
def test_sir_is_calibrated(sir):
    found = sir()
    assert least_p(found) > LIMIT
    assert np.quantile(found.ess.min(axis=1), 0.05) > sbc.DRAWS_A_BIN * BINS
    for level in found.levels.T:
        inside = coverage(level, 0.9)
        assert inside.low <= 0.9 <= inside.high


@pytest.mark.slow
@pytest.mark.parametrize("fault", [{"power": -1.0}, {"power": 0.5}, {"forgets": True}], ids=["sign", "root of the weights", "weights forgotten"])
def test_a_faulty_sir_is_found_out(sir, fault):
    assert least_p(sir(**fault)) <= FAILS


# -- tempered sequential Monte Carlo ----------------------------------------------------------------------------------------------------------


def tempered_runs(**options):
    """`run(sign, jacobian, forgets)`: replications, with the sign of the weights and the Jacobian's share as given."""
    honest_step, volume = tempered_smc.feynman_kac_step, Coordinates.log_determinant
    kernel = kernels.tempered(**options)

    @jax.jit
    def run(keys, sign, jacobian, forgets):
        def step(key, particles, log_weights, move, log_potential, resample, resampled):
            return honest_step(key, particles, log_weights, move, lambda moved: sign * log_potential(moved), resample, resampled)

        def mutant(key, particles, density):
            after, info = kernel(key, particles, density)
            equal = jnp.full_like(after.log_weights, -jnp.log(after.log_weights.shape[0]))
            return after._replace(log_weights=jnp.where(forgets, equal, after.log_weights)), info

        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(tempered_smc, "feynman_kac_step", step)
            patch.setattr(Coordinates, "log_determinant", lambda self, position: jacobian * volume(self, position))
            return jax.lax.map(sbc.replicate(toys.skewed(), mutant, 500, bins=BINS), keys)

    def call(sign=1.0, jacobian=1.0, forgets=False):
        keys = jax.random.split(jax.random.key(SEED), REPLICATIONS)
        return jax.tree.map(np.asarray, run(keys, jnp.float32(sign), jnp.float32(jacobian), forgets))

    return call


@pytest.fixture(scope="module")
def tempered(optimised):
    """In few stages: what the weights do."""
    return tempered_runs(final_stages=0, target_ess=0.2)


@pytest.fixture(scope="module")
def tempered_slowly(optimised):
    """In many stages with many moves: what the moves do."""
    return tempered_runs(final_stages=0, target_ess=0.8, moves=4)


@pytest.mark.slow
def test_laplace_is_calibrated(keypoint_session, optimised):
    """On an arm whose markers four cameras see."""
    problem = problem_of(build_model("arm_markers", keypoint_session))
    found = ranks(sbc.replicate(problem, kernels.laplace(fallback="none"), 256, bins=BINS))
    assert least_p(found) > LIMIT
    assert np.quantile(found.ess.min(axis=1), 0.05) > 0.9 * sbc.DRAWS_A_BIN * BINS


@pytest.mark.slow
def test_tempered_is_calibrated(tempered):
    assert least_p(tempered()) > LIMIT


@pytest.mark.long
@pytest.mark.parametrize("fault", [{"sign": -1.0}, {"forgets": True}], ids=["sign", "weights forgotten"])
def test_a_faulty_tempered_is_found_out(tempered, fault):
    assert least_p(tempered(**fault)) <= FAILS


@pytest.mark.long
def test_a_dropped_jacobian_is_found_out(tempered_slowly):
    """By default its moves alone, in tests/closed_forms/test_invariance.py."""
    assert least_p(tempered_slowly()) > LIMIT
    found = tempered_slowly(jacobian=0.0)
    assert least_p(found) <= FAILS
    # Moves that a wrong density refuses leave equal particles behind.
    assert np.median(found.ess[:, 1]) < 0.5 * np.median(found.ess[:, 0])


# -- and the others ---------------------------------------------------------------------------------------------------------------------------


@pytest.mark.long
@pytest.mark.usefixtures("optimised")
def test_annealed_is_not_calibrated():
    """A mode seeker: truths lie outside of its spread."""
    found = ranks(sbc.replicate(toys.skewed(), kernels.annealed(), 500, bins=BINS))
    assert least_p(found) <= FAILS
    assert coverage(found.levels[:, 0], 0.9).high < 0.6


@pytest.mark.slow
def test_truths_at_a_limit_are_ranked_at_random():
    """Every particle is the truth: ties only, and a uniform rank all the same."""
    problem = toys.gaussian()

    def frozen(key, particles, density):
        after, info = kernels.sir()(key, particles, density)
        return after._replace(states=jax.tree.map(jnp.zeros_like, after.states)), info

    still = dataclasses.replace(problem, quantities=dataclasses.replace(problem.quantities, compute=lambda state: 0.0 * state["x"]))
    found = ranks(sbc.replicate(still, frozen, 50, frames=1, bins=BINS))
    assert bands.p_values(bands.rank_counts(found.ranks[:, :2], BINS)).min() > LIMIT
    assert abs(found.levels.mean() - 0.5) < 4 / np.sqrt(12 * found.levels.size)


def test_effective_sizes_count_equal_states_and_common_ancestors_once():
    weights = jnp.full(8, 1 / 8)
    states, merged = {"x": jnp.asarray(np.repeat(np.random.default_rng(0).normal(size=(4, 3)), 2, axis=0))}, jax.jit(sbc._merged)
    assert np.isclose(sbc._ess(weights), 8) and np.isclose(merged(weights, states), 4)
    uneven = jnp.array([0.5, 0.0, 0.1, 0.1, 0.1, 0.1, 0.1, 0.0])
    assert np.isclose(merged(uneven, states), 1 / (0.25 + 0.04 + 0.04 + 0.01), rtol=1e-5)
    info = jax.jit(kernels.sir())(
        jax.random.key(0), point_mass(toys.gaussian().first, 8), toys.gaussian().density({"seen": jnp.zeros(1)}, point_mass(toys.gaussian().first))
    )[1]
    before = point_mass(toys.gaussian().first, 8)._replace(states={"x": jnp.arange(16.0).reshape(8, 2)})
    by_ancestor = jax.jit(sbc._by_ancestor, static_argnums=3)
    assert np.isclose(by_ancestor(weights, before, info._replace(ancestors=jnp.array([0, 0, 0, 0, 5, 5, 5, 5])), 2), 2)
