"""Fewer draws of a frame are still a weighted sample of its posterior: in expectation every particle has its own weight."""

import dataclasses

import numpy as np
import pytest

from bayes_body.density.kernel import NO_ANCESTOR, FilterInfo
from bayes_body.density.spaces import euclidean
from bayes_body.results.posterior.agreement import by_chain
from bayes_body.results.posterior.chains import joined
from bayes_body.results.posterior.thinning import choose, thinned
from bayes_body.results.posterior.weighted import equal_weight_poses, frame_rhat
from bayes_body.tracking.draws import FrameResult

RUNS, PARTICLES, DOFS, REPEATED = 2, 60, 3, 4000
SPACES = {"pose": euclidean(("a", "b", "c"), ("rad",) * DOFS, "dof")}


def frame(log_weights, markov=None):
    rng = np.random.default_rng(0)
    runs, particles = log_weights.shape
    ones = np.ones((runs, 1), np.float32)
    info = FilterInfo(
        ancestors=rng.integers(0, particles, (runs, particles), np.int32),
        ess=np.ones(runs, np.float32),
        survival_rate=ones,
        inverse_temperatures=ones,
        log_evidence=np.zeros(runs, np.float32),
        lost=np.zeros(runs, bool),
        acceptance_rate=ones,
        evaluations=np.ones(runs, np.int32),
        markov=markov or {},
        messages={},
    )
    states = {"pose": rng.normal(size=(runs, particles, DOFS)).astype(np.float32)}
    return FrameResult(states, log_weights.astype(np.float32), info, np.ones(2, bool), 0.5, 0.25)


def skewed(rng):
    """Weights of which a few are large and some are zero."""
    weights = rng.gamma(0.3, size=PARTICLES)
    weights[:5] = 0
    weights[7] = 0.4 * weights.sum()
    return weights / weights.sum()


@pytest.mark.parametrize("draws", [20, 30, 50])
def test_the_expected_weight_of_a_particle_is_its_weight(draws):
    weights, sums, threshold = skewed(np.random.default_rng(1)), np.zeros(PARTICLES), np.inf
    for seed in range(REPEATED):
        places, chosen = choose(np.random.default_rng(seed), weights, draws)
        # No draw occurs twice, and the order stays.
        assert len(places) == draws and (np.diff(places) > 0).all() and chosen.sum() == pytest.approx(1, abs=1e-12)
        sums[places] += chosen
        threshold = min(threshold, chosen[chosen > 0].min())
    # The weight is the threshold with probability w / threshold, else 0; a weight above it is no matter of chance.
    error = np.sqrt(weights * np.maximum(threshold - weights, 0) / REPEATED)
    assert error[7] == 0 and (error > 0).sum() > PARTICLES - draws - 6
    assert (np.abs(sums / REPEATED - weights) < 5 * error + 1e-12).all()


def test_weights_that_are_all_alike_stay_alike():
    places, chosen = choose(np.random.default_rng(0), np.full(PARTICLES, 1 / PARTICLES), 20)
    np.testing.assert_allclose(chosen, 1 / 20, rtol=1e-12)
    # Every third particle.
    assert (np.diff(places) == 3).all()


def test_where_few_particles_count_all_of_these_stay():
    weights = np.zeros(PARTICLES)
    weights[[3, 30, 31]] = 0.5, 0.3, 0.2
    places, chosen = choose(np.random.default_rng(0), weights, 20)
    assert len(places) == 20 and {3, 30, 31} <= set(places.tolist()) and chosen[chosen > 0].tolist() == [0.5, 0.3, 0.2]


def test_a_thinned_frame_has_the_figures_of_all_particles():
    whole = frame(np.log(np.stack([skewed(np.random.default_rng(run)) for run in (1, 2)]) + 1e-300))
    few = thinned(whole, 5, 20, SPACES)
    assert few.log_weights.shape == (RUNS, 20) and few.states["pose"].dtype == np.float32 and (few.seconds, few.seconds_ready) == (0.5, 0.25)
    np.testing.assert_allclose(np.exp(few.log_weights).sum(axis=1), 1, rtol=1e-6)
    assert (few.info.ancestors == NO_ANCESTOR).all() and few.info.ancestors.shape == (RUNS, 20)
    weights = np.exp(whole.log_weights.astype(float))
    np.testing.assert_allclose(few.figures["ess"], weights.sum(axis=1) ** 2 / (weights**2).sum(axis=1), rtol=1e-6)
    np.testing.assert_allclose(few.figures["mean_pose"], np.einsum("rs,rsd->rd", weights, whole.states["pose"]), rtol=1e-4)
    assert few.figures["ancestors"].tolist() == [len(set(of_run)) for of_run in whole.info.ancestors.tolist()]
    # Who asks the frame for its R-hat is told that of all particles.
    np.testing.assert_allclose(frame_rhat(few, 5, "pose", SPACES["pose"]), frame_rhat(whole, 5, "pose", SPACES["pose"]), rtol=1e-6)
    assert equal_weight_poses(few, 5).shape == (RUNS, 20, DOFS)
    # The same again, and without a word about it if there is nothing to leave out.
    assert thinned(whole, 5, 20, SPACES).states["pose"].tobytes() == few.states["pose"].tobytes()
    assert thinned(whole, 5, PARTICLES, SPACES) is whole


@pytest.mark.parametrize(("draws", "length"), [(20, 5), (22, 5), (3, 1), (59, 14)])
def test_markov_chains_are_thinned_evenly(draws, length):
    chains = 4
    steps = np.arange(PARTICLES, dtype=np.float32)
    markov = {"length": np.full(RUNS, PARTICLES // chains, np.int32), "ess": np.ones((RUNS, DOFS), np.float32)}
    whole = frame(np.full((RUNS, PARTICLES), -np.log(PARTICLES)), markov)
    whole = dataclasses.replace(whole, states={"pose": np.broadcast_to(steps[:, None], (RUNS, PARTICLES, DOFS))})
    few = thinned(whole, 0, draws, SPACES)
    assert few.info.markov["length"].tolist() == [length] * RUNS
    found = by_chain(few.states["pose"][:, :, None], length)[0, :, :, 0, 0]
    assert found.shape == ((chains, length) if draws >= chains else found.shape)
    # Of each chain its last draw, and others at even distances before it.
    by_chain_of_all = steps.reshape(chains, -1)
    assert (found[:, -1] == by_chain_of_all[:, -1]).all() and set(np.diff(found, axis=1).ravel().tolist()) <= {1.0, 2.0, 3.0}
    assert "markov_rhat_pose" in few.figures


def a_run(seed, particles):
    """One run, whose particles are skewed and whose mean is off by chance."""
    rng = np.random.default_rng(seed)
    whole = frame(np.log(rng.gamma(2.0, size=(1, particles))))
    log_weights = whole.log_weights - np.log(np.exp(whole.log_weights).sum())
    states = {"pose": (rng.gamma(2.0, size=(1, particles, DOFS)) + 0.2 * rng.normal(size=DOFS)).astype(np.float32)}
    return dataclasses.replace(whole, states=states, log_weights=log_weights)


def test_runs_that_were_thinned_before_they_are_put_together_have_the_figures_of_all_particles():
    runs = [a_run(seed, 4000) for seed in range(4)]
    together = joined(runs, 3, SPACES)
    assert not together.figures and together.log_weights.shape == (4, 4000) and together.seconds == 2.0
    whole, few = thinned(together, 3, 200, SPACES).figures, joined([thinned(of_run, 3, 200, SPACES) for of_run in runs], 3, SPACES).figures
    assert whole.keys() == few.keys() and list(few["particles"]) == [4000] * 4
    for name in ("ess", "pareto_k", "ancestors", "mean_pose"):
        np.testing.assert_allclose(few[name], whole[name], rtol=1e-5, err_msg=name)
    # The means are those of all particles, so only the spread of 4 x 200 draws is uncertain: a relative error of a squared spread of
    # sqrt((kurtosis - 1) / draws), kurtosis 6 of this distribution.
    assert few["independent_draws"] == pytest.approx(whole["independent_draws"], rel=4 * np.sqrt(5 / 800))
    # The squared R-hat has a term (n - 1) / n for halves of n draws, which is 1 / 100 smaller.
    np.testing.assert_allclose(few["rhat_pose"], whole["rhat_pose"], atol=0.01)
    assert (whole["rhat_pose"] > 1.005).any()
