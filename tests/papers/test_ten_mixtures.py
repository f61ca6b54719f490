"""The truth from runs of tempered SMC, on posteriors in closed form; rows that a file has already, and what the table says of them."""

import json

import jax
import jax.numpy as jnp
import numpy as np
import numpyro.distributions as dist
import pytest
import ten_mixtures
import true_mean
from control_variates import steadied
from five_walks import WALKS, side_camera
from papers.test_estimator_variance import POSE, _density
from scipy.special import digamma

from bayes_body.base.errors import InputError
from bayes_body.density.density import Density
from bayes_body.density.factor import Factor, Particles, Transition

FIGURES = {
    "ratio_median": 60.0,
    "ratio_interval": (30.0, 95.0),
    "per_dof": {"hip": [70.0, 50.0, 90.0], "knee": [1.1, 0.8, 1.4]},
    "settings": {"truth_by": "tempering", "truth_rhat": 1.004, "truth_noise": 0.02, "truth_converged": True, "truth_effective": 900.0},
}
SETTINGS = {"model": "legs_by_phase", "runs": 10}


def _step(before):
    return {"pose": dist.Normal(before["pose"], 1.0).to_event(1)}


def _noise(state, scale):
    return {"pose": dist.Normal(state["pose"], scale).to_event(1)}


def _two_modes(values, data):
    """Two narrow normal modes at -1 and 1, the right one with three times the height."""
    offsets = jnp.stack([values[POSE] + 1, values[POSE] - 1])
    return jax.nn.logsumexp(-0.5 * jnp.sum((offsets / 0.05) ** 2, axis=1) + jnp.log(jnp.array([0.25, 0.75]))) + 0 * data


def _bimodal():
    """Density whose likelihood has two modes between which no chain moves, and its mean."""
    factor = Factor("modes", "likelihood", (POSE,), jax.tree_util.Partial(_two_modes))
    transition = Transition("walk", jax.tree_util.Partial(_step), jax.tree_util.Partial(_noise))
    previous = Particles({"pose": jnp.zeros((1, 2))}, jnp.zeros(1))
    # The prior is the same at both modes.
    return Density(transition, (factor,), {"modes": jnp.zeros(())}, previous), 0.75 - 0.25


@pytest.mark.slow
@pytest.mark.usefixtures("optimised")
def test_tempered_runs_know_the_shares_of_modes_that_no_chain_leaves():
    density, mean = _bimodal()
    truth = true_mean.true_mean_by_tempering(jax.random.key(0), density, 1024, 12)
    assert truth.by == "tempering" and truth.converged and 100 < truth.effective < 12 * 1024
    assert np.all(np.abs(truth.mean - mean) < 5 * truth.sd / np.sqrt(2 * truth.effective))
    assert np.allclose(truth.sd, np.sqrt(1 - mean**2), atol=0.1)
    # Two halves differ as their noise says.
    assert np.all((truth.halves[0] - truth.halves[1]) ** 2 < 16 * 2 * truth.noise)


@pytest.mark.slow
def test_tempered_runs_on_one_mode_have_its_mean():
    density, mean = _density()
    truth = true_mean.true_mean_by_tempering(jax.random.key(1), density, 512, 6)
    assert truth.converged and np.all(np.abs(truth.mean - mean) < 5 * truth.sd / np.sqrt(2 * truth.effective))


def test_groups_are_weighted_by_their_evidence_and_their_rhat_is_that_of_their_means():
    rng, means = np.random.default_rng(0), np.array([[0.0, 5.0], [1.0, 5.0], [2.0, 5.0], [40.0, 5.0]])
    groups = true_mean.Groups(np.array([0.0, 0.0, 0.0, -60.0]), means, means**2 + 9.0)
    mean, variance, between = groups.pooled()
    assert np.allclose(mean, [1, 5]) and np.allclose(variance, [9 + 2 / 3, 9]) and np.allclose(between, [1, 0])
    assert groups.effective == pytest.approx(3 * (9 + 2 / 3))
    assert true_mean.group_rhat(groups) == pytest.approx(np.sqrt(1 + 1 / (8 + 2 / 3)))
    # Groups of n independent draws have R-hat² = 1 + 1/n.
    draws = rng.normal(size=(400, 25, 3))
    same = true_mean.Groups(np.zeros(400), draws.mean(axis=1), (draws**2).mean(axis=1))
    assert true_mean.group_rhat(same) ** 2 - 1 == pytest.approx(1 / 25, rel=0.35)


def test_a_row_names_the_worst_dof_and_whether_the_truth_is_known():
    row = ten_mixtures.row_of(WALKS[3], 10, FIGURES)
    assert (row["walk"], row["held_out"], row["worst_dof"], row["worst_ratio"], row["worst_interval"]) == ("35_01", True, "knee", 1.1, [0.8, 1.4])
    assert row["truth_known"]
    doubtful = ten_mixtures.row_of(WALKS[0], 20, FIGURES | {"settings": FIGURES["settings"] | {"truth_noise": 0.2}})
    assert not doubtful["truth_known"]
    table = ten_mixtures.table([row, doubtful])
    assert "35_01*" in table and "knee 1.1 (0.8-1.4)" in table and "the truth is known in 1 of 2" in table
    assert "there the median ratio is 60 to 60, and the worst dof's 1.1" in table


def test_mixtures_in_the_file_are_not_measured_again(tmp_path):
    file = tmp_path / "ten.json"
    assert ten_mixtures.finished(file, SETTINGS) == []
    file.write_text(json.dumps({"settings": SETTINGS, "mixtures": [{"walk": "cycle", "frame": 10}]}))
    assert ten_mixtures.finished(file, SETTINGS) == [{"walk": "cycle", "frame": 10}]
    with pytest.raises(InputError, match="measured with runs = 10; expected the settings of this run; name another --json"):
        ten_mixtures.finished(file, SETTINGS | {"runs": 50})
    file.write_text("[1, 2]")
    with pytest.raises(InputError, match="not a file of this program"):
        ten_mixtures.finished(file, SETTINGS)


def test_the_camera_sees_the_same_with_more_pixels():
    (camera,) = side_camera().cameras
    assert camera.size_px == (1280, 960) and camera.focal_px == (1200.0, 1200.0) and camera.centre_px == (639.5, 479.5)


def test_gradients_take_the_noise_out_of_a_mean_and_no_bias_in():
    """A skewed posterior: y is the logarithm of a gamma variable. Its mean is the digamma function's value."""
    rng, shape = np.random.default_rng(0), 3.0
    plain, steady = [], []
    for _ in range(100):
        runs = [np.log(rng.gamma(shape, size=(400, 1))) for _ in range(2)]
        found = steadied(runs, runs, [shape - np.exp(y) for y in runs])
        plain += [y.mean() for y in runs]
        steady += [values.mean() for values in found]
    assert np.std(steady) < np.std(plain) / 5
    assert abs(np.mean(steady) - digamma(shape)) < 4 * np.std(steady) / np.sqrt(len(steady))
    # A draw at which the density has no slope leaves the means as they are.
    assert np.array_equal(steadied(runs, runs, [np.full_like(y, np.nan) for y in runs])[0], runs[0])
