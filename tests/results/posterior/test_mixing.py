"""How chains mixed: against autocorrelations in closed form, chains that sit apart, and the sentences that a reader is told."""

import numpy as np
import pytest
import xarray as xr

from bayes_body.results.posterior.agreement import by_chain
from bayes_body.results.posterior.diagnostics import diagnose, sentences, worst_figures
from bayes_body.results.posterior.mixing import autocorrelation, mixing_of

RUNS, CHAINS, LENGTH, FRAMES, DOFS = 2, 4, 100, 3, 2


def autoregressive(rho, shape, seed=0):
    """Chains whose autocorrelation is rho^lag, along the last axis, of variance 1."""
    rng = np.random.default_rng(seed)
    values = rng.normal(size=shape)
    for step in range(1, shape[-1]):
        values[..., step] = rho * values[..., step - 1] + np.sqrt(1 - rho**2) * values[..., step]
    return values


@pytest.fixture
def chained(make_tree):
    """`chained(pose=..., acceptance=...)`: a tree of a kernel of Markov chains."""

    def call(pose=None, runs=RUNS, **figures):
        draws = CHAINS * LENGTH
        if pose is None:
            pose = np.random.default_rng(1).normal(size=(runs, draws, FRAMES, DOFS))
        tree = make_tree("hmc", runs=runs, draws=draws, frames=FRAMES, pose=pose, acceptance_rate=np.full((runs, FRAMES, 1), 0.7))
        each = (runs, FRAMES, CHAINS)
        given = {
            "acceptance": np.full(each, 0.7),
            "divergences": np.zeros(each, int),
            "energy_fraction": np.ones(each),
            "step": np.full(each, 0.2),
            "ess": np.full((runs, FRAMES, DOFS), 300.0),
            "length": np.full((runs, FRAMES), LENGTH),
        } | figures
        dims = {"ess": ("chain", "frame", "dof"), "length": ("chain", "frame")}
        arrays = {f"markov_{name}": (dims.get(name, ("chain", "frame", "markov_chain")), values) for name, values in given.items()}
        tree["filter"] = xr.DataTree(tree["filter"].to_dataset().assign(arrays))
        return tree

    return call


def test_a_kernel_without_chains_has_no_mixing(make_tree):
    assert mixing_of(make_tree()) is None and diagnose(make_tree()).mixing is None


def test_draws_lie_chain_after_chain():
    draws = np.arange(11.0)[None, :, None, None]
    assert by_chain(draws, 4)[0, :, :, 0, 0].tolist() == [[0, 1, 2, 3], [4, 5, 6, 7]]
    assert by_chain(draws, 20).shape == (1, 1, 11, 1, 1)


@pytest.mark.parametrize("rho", [0.0, 0.8])
def test_autocorrelation_of_an_autoregression(rho):
    found = autocorrelation(autoregressive(rho, (200, 400)))
    assert np.allclose(found[:10], rho ** np.arange(10), atol=0.03)
    assert np.isnan(autocorrelation(np.ones((2, 50)))).all()


def test_chains_that_agree_are_told_from_chains_that_sit_apart(chained):
    agreeing = mixing_of(chained())
    assert agreeing.rhat.shape == (RUNS, FRAMES, DOFS) and agreeing.rhat.max() < 1.05
    pose = np.random.default_rng(1).normal(size=(RUNS, CHAINS * LENGTH, FRAMES, DOFS))
    pose[1, :LENGTH, 2, 1] += 3
    found = mixing_of(chained(pose), block=1).rhat
    assert found[1, 2, 1] > 1.3
    found[1, 2, 1] = 1
    assert found.max() < 1.05


def test_effective_draws_count_for_the_run(chained):
    ess = np.full((RUNS, FRAMES, DOFS), 300.0)
    ess[1, 2, 0] = 7.0
    diagnosis = diagnose(chained(ess=ess))
    assert diagnosis.ess[1, 2] == 7 and diagnosis.ess[0, 0] == 300
    assert any("7 effective particles" in sentence for sentence in sentences(diagnosis))


def test_a_sound_run_says_nothing(chained):
    diagnosis = diagnose(chained())
    assert sentences(diagnosis) == []
    assert worst_figures(diagnosis)["divergences"] == 0 and worst_figures(diagnosis)["markov_rhat_max"] < 1.05


APART = {"apart": True}
CROSSED = {
    "divergences": ({"divergences": 2}, "frame 1: 2% of the trajectories diverged (limit 1%)", "--set step=0.1"),
    "energy": ({"energy_fraction": 0.1}, "frame 1: momenta change the energy too little to reach the tails, E-BFMI 0.10 (limit 0.3)", "burn_in"),
    "long": (APART, "frame 1: the chains of a frame did not mix, R-hat up to", "raise --leapfrog-steps"),
    "rejected": (
        APART | {"acceptance": 0.2},
        "frame 1: the chains of a frame did not mix, R-hat up to",
        "with 0.20 of the trajectories accepted, lower",
    ),
}


@pytest.mark.parametrize("limit", CROSSED)
def test_a_sentence_names_the_frames_and_what_to_change(chained, limit):
    crossed, words, remedy = CROSSED[limit]
    pose = np.random.default_rng(1).normal(size=(RUNS, CHAINS * LENGTH, FRAMES, DOFS))
    if crossed.get("apart"):
        # In both runs alike: the runs agree, the chains do not.
        pose[:, :LENGTH, 1, 0] += 3
    figures = {}
    for name, value in crossed.items():
        if name != "apart":
            figures[name] = np.full((RUNS, FRAMES, CHAINS), 0 if name == "divergences" else 1 if name == "energy_fraction" else 0.7, type(value))
            figures[name][:, 1] = value
    (sentence,) = sentences(diagnose(chained(pose, **figures)))
    assert sentence.startswith(words) and remedy in sentence


def test_a_single_chain_has_no_rhat(chained):
    tree = chained(length=np.full((RUNS, FRAMES), CHAINS * LENGTH))
    assert np.isnan(mixing_of(tree).rhat).all() and sentences(diagnose(tree)) == []
    assert worst_figures(diagnose(tree))["markov_rhat_max"] is None
