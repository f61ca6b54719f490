"""What burn-in finds: the covariance of a Gaussian from few draws, alike in all chains, and steps that are accepted as asked."""

from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg

from bayes_body.base.errors import InputError
from bayes_body.kernels import hmc
from bayes_body.kernels.batching import axes_of, over_particles
from bayes_body.kernels.hmc.adaptation import Plan, geometric_mean, init
from bayes_body.kernels.hmc.hamiltonian import Chain, Schedule, run_chain

DOFS, CHAINS = 6, 8
# Deviations from 1 to 100 along directions of no axis.
AXES = np.linalg.qr(np.random.default_rng(0).normal(size=(DOFS, DOFS)))[0]
COVARIANCE = (AXES * np.logspace(0, 2, DOFS) ** 2) @ AXES.T
PRECISION = jnp.asarray(np.linalg.inv(COVARIANCE))
SCHEDULE = Schedule(draws=200, burn_in=40, thinning=1, leapfrog_steps=6, jitter=0.3, sampler="hmc", target_acceptance=0.8, adapts_mass=True)


@cache
def _run(schedule: Schedule, chains: int = CHAINS) -> Chain:
    """Chains on the Gaussian, from nearby starts, with a unit mass."""
    batch = -(-chains // jax.device_count())
    axes = axes_of(chains, batch, "chain")

    def one(own, precision) -> Chain:
        key, position = own
        return run_chain(key, {"x": position}, lambda p: -0.5 * p["x"] @ precision @ p["x"], jnp.asarray(0.3), jnp.ones(DOFS), schedule, axes)

    starts, keys = jax.random.normal(jax.random.key(1), (chains, DOFS)), jax.random.split(jax.random.key(0), chains)
    return jax.jit(lambda keys, starts: over_particles(one, (keys, starts), PRECISION, batch, False, "chain"))(keys, starts)


def test_of_a_gaussian_the_geometric_mean_is_its_covariance_from_a_few_draws_anywhere() -> None:
    # Twenty draws that are not the Gaussian's own, far from its middle; the first matrix counts as five of them.
    draws = np.random.default_rng(1).normal(3, 1, (4000, 3))
    precision = np.array([[2.0, 0.3, 0.0], [0.3, 1.0, 0.2], [0.0, 0.2, 0.5]])
    for count, near in ((20, 0.7), (4000, 0.01)):
        rows = np.hstack([np.ones((count, 1)), draws[:count], -draws[:count] @ precision])
        found = np.asarray(jax.jit(geometric_mean)(jnp.asarray(rows.T @ rows)))
        ratios = scipy.linalg.eigvalsh(found, np.linalg.inv(precision))
        assert np.abs(np.log(ratios)).max() < near


def test_it_is_the_mean_of_both_covariances_where_they_disagree() -> None:
    # Not Gaussian: uncorrelated, variances 4 and 9 of the draws, 1 and 1 / 4 of the scores. The many draws outweigh those that the prior counts as.
    count = 1e8
    moments = jnp.asarray(np.diag([1.0, 4.0, 9.0, 1.0, 0.25]) * count)
    np.testing.assert_allclose(jax.jit(geometric_mean)(moments), np.diag([np.sqrt(4 / 1), np.sqrt(9 / 0.25)]), rtol=1e-4)


def test_chains_that_learn_explore_a_long_valley() -> None:
    learned, fixed = _run(SCHEDULE), _run(SCHEDULE._replace(adapts_mass=False))
    found, missed = (np.cov(np.asarray(chain.positions["x"]).reshape(-1, DOFS).T) for chain in (learned, fixed))
    assert np.all(np.abs(np.log(scipy.linalg.eigvalsh(found, COVARIANCE))) < 0.35)
    # With a unit mass no chain comes to the valley's ends.
    assert scipy.linalg.eigvalsh(missed, COVARIANCE)[0] < 0.3
    # One step for all, accepted as asked and of the size that six dofs of unit deviation allow.
    steps = np.asarray(learned.step)
    assert np.ptp(steps) == 0
    assert 0.5 < steps[0] < 1.6
    assert 0.65 < np.asarray(learned.acceptance).mean() < 0.95


@pytest.mark.slow
def test_chains_that_no_device_has_equally_many_of_learn_alike() -> None:
    chains = _run(SCHEDULE, 3)
    steps = np.asarray(chains.step)
    assert steps.shape == (3,) and np.ptp(steps) == 0
    assert np.all(np.abs(np.log(scipy.linalg.eigvalsh(np.cov(np.asarray(chains.positions["x"]).reshape(-1, DOFS).T), COVARIANCE))) < 0.7)


@pytest.mark.slow
def test_burn_in_ends_what_is_learned() -> None:
    # Later draws change nothing: a run of 50 is the beginning of one of 200.
    long, short = _run(SCHEDULE), _run(SCHEDULE._replace(draws=50))
    np.testing.assert_allclose(np.asarray(long.step), np.asarray(short.step))
    np.testing.assert_allclose(np.asarray(long.positions["x"])[:, :50], np.asarray(short.positions["x"]), rtol=1e-3)


@pytest.mark.slow
def test_scores_that_are_none_teach_nothing() -> None:
    """A density whose gradient is NaN in one half leaves a matrix that is one."""

    def one(own, _) -> Chain:
        key, position = own

        def wall(p):
            return jnp.where(p["x"][0] < 0, jnp.nan * p["x"][0], -0.5 * jnp.sum(p["x"] ** 2))

        schedule = SCHEDULE._replace(burn_in=16, draws=20)
        return run_chain(key, {"x": position}, wall, jnp.asarray(0.3), jnp.ones(2), schedule, ("chain",))

    starts = jnp.abs(jax.random.normal(jax.random.key(1), (4, 2)))
    chains = jax.jit(lambda k, x: over_particles(one, (k, x), jnp.zeros(()), 4, False, "chain"))(jax.random.split(jax.random.key(0), 4), starts)
    x = np.asarray(chains.positions["x"])
    assert np.all(np.isfinite(x)) and np.all(x[..., 0] >= 0)
    assert x.std() > 0.3


def test_a_first_matrix_that_is_no_covariance_leaves_its_scales() -> None:
    """One that rounding has made indefinite."""
    broken = jnp.array([[4.0, 2.1], [2.1, 1.0]])
    found = jax.jit(lambda broken: init(Plan(8, 0.8, True), jnp.asarray(0.1), broken, {"x": jnp.zeros(2)}))(broken)
    assert found.metric is not None
    np.testing.assert_allclose(found.metric.inverse_mass, np.diag([4.0, 1.0]), rtol=1e-6)


def test_too_short_a_burn_in_is_refused() -> None:
    with pytest.raises(InputError, match=r"burn_in = 4 is too short .* at least 8"):
        hmc(mass="adapted", burn_in=4)
