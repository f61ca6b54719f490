"""Ranks of a truth with unknown lengths, cameras and delays: an arm with velocities. Priors and faults are arguments of one compiled program."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from workshop.calibration.unknown_arm import DRIFTING, FAULTS, LONG, SHORT, STATIC, problem_with_unknowns, told, with_priors

from bayes_body import kernels
from bayes_body.workshop.calibration import bands, looks, sbc
from bayes_body.workshop.calibration.verdict import coverage

pytestmark = pytest.mark.usefixtures("optimised")

REPLICATIONS, BINS, FRAMES, SEED = 400, 20, 5, 100


@pytest.fixture(scope="module")
def problem(keypoint_session):
    return problem_with_unknowns(keypoint_session)


def p_values(runs):
    return bands.p_values(bands.rank_counts(runs.ranks, BINS))


def quantities(problem, name):
    """The places of the entries of an unknown among the quantities."""
    return [place for place, label in enumerate(problem.quantities.names) if label.startswith(f"{name} ")]


# -- the kernel of keypoints, and mutants -----------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def laplace(problem, optimised):
    """`laplace(retention, delay_sd, ...)`: replications, with the faults that are named."""
    kernel = kernels.laplace(fallback="none")

    @jax.jit
    def run(keys, retention, delay_sd, seen, sign, spread, memory, again):
        true = with_priors(problem, retention, delay_sd)
        transition, factors = told(true, seen, sign, spread, memory, again)

        def mutant(key, particles, density):
            return kernel(key, particles, dataclasses.replace(density, transition=transition, factors=factors))

        return jax.lax.map(sbc.replicate(true, mutant, 512, frames=FRAMES, bins=BINS), keys)

    def call(retention=DRIFTING, delay_sd=SHORT, seen=1.0, sign=1.0, spread=False, memory=False, again=0.0):
        keys = jax.random.split(jax.random.key(SEED), REPLICATIONS)
        numbers = [jnp.float32(number) for number in (retention, delay_sd, seen, sign)]
        return jax.tree.map(np.asarray, run(keys, *numbers, spread, memory, jnp.float32(again)))

    return call


@pytest.mark.slow
@pytest.mark.parametrize("retention", [DRIFTING, STATIC], ids=["drifting", "static"])
def test_laplace_is_calibrated_for_unknowns(laplace, retention):
    runs = laplace(retention)
    p = p_values(runs)
    print(np.sort(p)[:4])
    assert p.min() > 0.01 / len(p)
    assert np.quantile(runs.ess[:, 0], 0.05) > sbc.DRAWS_A_BIN * BINS


@pytest.mark.long
@pytest.mark.parametrize("fault", FAULTS)
def test_faulty_unknowns_are_found_out(laplace, fault):
    p = p_values(laplace(**FAULTS[fault]))
    print(fault, np.sort(p)[:4])
    # A check with this test alone would fail at its first look.
    assert p.min() <= looks.limits(0, 1, len(p)).fails


@pytest.mark.long
def test_long_delays_are_too_certain(problem, laplace):
    """A delay times a velocity is not normal, and one Gaussian a frame is too sure of it (docs/decisions/47_unknowns.md). Nothing else suffers."""
    runs = laplace(STATIC, delay_sd=LONG)
    inside = {name: [coverage(runs.levels[:, place], 0.9) for place in quantities(problem, name)] for name in ("delays", "lengths", "cameras")}
    print({name: [round(interval.low, 3) for interval in intervals] for name, intervals in inside.items()})
    assert inside["delays"][0].high < 0.9
    assert all(interval.high > 0.87 for name in ("lengths", "cameras") for interval in inside[name])


# -- and others -------------------------------------------------------------------------------------------------------------------------------


@pytest.mark.long
@pytest.mark.parametrize(
    "kernel",
    [
        pytest.param(kernels.tempered(prediction="gaussian"), id="tempered"),
        pytest.param(kernels.hmc(prediction="gaussian", chains=2, mass="curvature_matrix"), id="hmc"),
    ],
)
def test_other_kernels_are_calibrated_for_unknowns(problem, kernel):
    """By one Gaussian a frame. Particles that carry unknowns would need to be many."""
    true, bins = with_priors(problem, DRIFTING, SHORT), 10
    keys = jax.random.split(jax.random.key(1), 100)
    runs = jax.tree.map(np.asarray, jax.jit(lambda keys: jax.lax.map(sbc.replicate(true, kernel, 200, frames=2, bins=bins), keys))(keys))
    p = bands.p_values(bands.rank_counts(runs.ranks, bins))
    inside = [coverage(runs.levels[:, place], 0.9) for place in quantities(problem, "lengths")]
    print(np.sort(p)[:4], np.quantile(runs.ess, 0.05, axis=0), [round(interval.low, 2) for interval in inside])
    assert p.min() > 0.01 / len(p)
