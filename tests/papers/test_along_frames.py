"""Errors along frames where Kalman's filter has the truth, and where what the means of a single chain forget has a closed form."""

import along_frames as path
import cv2
import jax
import jax.numpy as jnp
import numpy as np
import numpyro.distributions as dist
import pytest
from ratio_plot import draw_ratios

from bayes_body.density.density import Density
from bayes_body.density.factor import Factor, Particles, Transition, Variable
from bayes_body.kernels import hmc, sir

POSE = Variable("pose")
KEPT, NOISE, SEEN = 0.9, np.array([0.5, 1.5]), 0.7
START = np.array([0.3, -0.2])
OBSERVED = np.array([[0.4, -1.0], [1.7, 0.3], [0.2, 0.9], [-0.9, 2.8]])
SMALL = {"burn_in": 30, "leapfrog_steps": 6, "step": 0.6, "jitter": 0.3}


def _step(previous):
    return {"pose": dist.Normal(KEPT * previous["pose"], NOISE).to_event(1)}


def _noise(state, scale):
    return {"pose": dist.Normal(state["pose"], scale * NOISE).to_event(1)}


def _look(values, seen):
    return jnp.sum(dist.Normal(values[POSE], SEEN).log_prob(seen))


def _mixture(copies=1):
    return Particles({"pose": jnp.tile(jnp.asarray(START), (copies, 1))}, jnp.full(copies, -jnp.log(copies)))


@pytest.fixture(scope="module")
def densities():
    transition = Transition("kept", jax.tree_util.Partial(_step), jax.tree_util.Partial(_noise))
    factor = Factor("seen", "likelihood", (POSE,), jax.tree_util.Partial(_look))
    return [Density(transition, (factor,), {"seen": jnp.asarray(seen)}, _mixture()) for seen in OBSERVED]


def _kalman(handed_on):
    """Filtered means and variances; of the variance only the share `handed_on` goes into the next prediction."""
    mean, variance, out = START, np.zeros(2), []
    for seen in OBSERVED:
        mean, variance = KEPT * mean, KEPT**2 * handed_on * variance + NOISE**2
        gain = variance / (variance + SEEN**2)
        mean, variance = mean + gain * (seen - mean), (1 - gain) * variance
        out.append((mean, variance))
    return [np.array(each) for each in zip(*out, strict=True)]


@pytest.fixture(scope="module")
def truth(densities):
    return path.true_path(jax.random.key(0), densities, _mixture(), draws=1600, starts=2000)


@pytest.mark.long
def test_the_truth_is_kalmans(truth):
    mean, variance = _kalman(1.0)
    # Of 1600 draws a run, every third state of 16 chains, 400 are the least.
    assert np.all(np.abs(truth.mean - mean) < 4 * np.sqrt(variance / 800))
    assert np.allclose(truth.variance, variance, rtol=0.25)
    assert np.all(truth.error < 16 * 2 * variance / 400)


@pytest.mark.long
def test_bias_and_variance_are_the_error(densities, truth):
    runs = path.follow(jax.random.key(1), densities, _mixture(), sir(), 50, 40)
    assert runs.means.shape == (40, 4, 2) and runs.evaluations == 50 and runs.seconds > 0
    found = path.errors(runs, truth)
    assert np.allclose(found.bias + found.variance, np.mean((runs.means - truth.mean) ** 2, axis=0) / truth.variance)
    # As good as 5 to 50 independent draws, and hardly biased.
    assert 1 / 50 < np.median(found.variance) < 1 / 5 and np.median(found.bias) < 0.3 * np.median(found.variance)


@pytest.mark.long
def test_means_of_one_chain_forget_the_posteriors_spread(densities):
    exact, forgetful = _kalman(1.0), _kalman(0.0)
    truth = path.TruePath(*exact, np.zeros((4, 2)))
    found = {
        carry: path.follow(jax.random.key(2), densities, _mixture(3), hmc(**SMALL, chains=1, carry=carry), 200, 30) for carry in ("means", "draws")
    }
    bias = {carry: path.errors(runs, truth).bias for carry, runs in found.items()}
    spread = found["means"].means.std(axis=0, ddof=1) / np.sqrt(30)
    assert np.all(np.abs(found["means"].means.mean(axis=0) - forgetful[0]) < 4.5 * spread)
    # Every gain but the first is too small, and in the last frame of the first dof that matters.
    assert np.isclose(bias["means"][-1, 0], (forgetful[0] - exact[0])[-1, 0] ** 2 / exact[1][-1, 0], rtol=0.5)
    assert bias["means"][-1, 0] > 5 * bias["draws"][-1, 0]


@pytest.mark.long
def test_figures_sentences_and_a_plot(densities, truth, tmp_path, monkeypatch):
    monkeypatch.setattr(path, "true_path", lambda *_, **__: truth)
    filters = {"hmc, draws": (hmc(**SMALL, chains=4), 80), "sir": (sir(), 80)}
    figures = path.along(jax.random.key(3), densities, _mixture(), filters, 10)
    for name in filters:
        of = figures[name]
        assert all(len(of[each]) == 4 for each in ("bias", "variance", "error", "error_interval"))
        assert all(low <= error <= high for error, (low, high) in zip(of["error"], of["error_interval"], strict=True))
    assert figures["sir"]["evaluations"] == 80 and figures["hmc, draws"]["evaluations"] > 600
    told = path.along_summary(figures).splitlines()
    assert len(told) in (3, 4) and told[1].startswith("along 4 frames, sir: error²")
    row = {"per_dof": {"a": (2.0, 1.0, 3.0), "b": (5.0, 4.0, 8.0)}}
    draw_ratios(tmp_path / "plot.png", {**row, "equal_seconds": row, "frames": figures})
    assert cv2.imread(str(tmp_path / "plot.png")).shape[1] > 1200
    draw_ratios(tmp_path / "one.png", {**row, "equal_seconds": row})
    assert cv2.imread(str(tmp_path / "one.png")).shape[1] < 1000


@pytest.mark.parametrize(
    ("difference", "words"),
    [((0.01, 0.01, 0.01), None), ((0.01, 0.03, 0.01), "from frame 1 of these on"), ((0.5, 0.0, 0.0), "from frame 0 of these on")],
)
def test_a_truth_that_is_not_known_is_said(difference, words):
    row = {"bias": [0.1, 0.1, 0.1], "variance": [0.1, 0.1, 0.1], "error": [0.2, 0.2, 0.2], "seconds": 1.0}
    # The smallest error of any filter counts.
    worse = row | {"error": [9.0, 9.0, 9.0]}
    lines = path.along_summary({"hmc": worse, "sir": row, "truth_difference": list(difference)}).splitlines()
    assert len(lines) == 3 + (words is not None)
    assert words is None or lines[-1].startswith(words)
