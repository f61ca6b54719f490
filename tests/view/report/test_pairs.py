"""The dependence of dofs: correlations within the runs, the frame and the dofs that are shown."""

import numpy as np
import pytest

from bayes_body.results.posterior.blocks import weights_of_runs
from bayes_body.view.report.dependence import adjusted, chosen_dofs, correlations, dependence
from bayes_body.view.report.figures import style
from bayes_body.view.report.pairs import pair_section

DRAWS = 400


@pytest.fixture(scope="module")
def dependent():
    """Draws of five dofs: in frame 3, dofs 1 and 3 have r = -0.9; in all frames, the runs are apart in dofs 2 and 4."""
    pose = 0.05 * np.random.default_rng(0).normal(size=(2, DRAWS, 5, 5))
    pose[:, :, 3, 3] = -0.9 * pose[:, :, 3, 1] + np.sqrt(1 - 0.9**2) * pose[:, :, 3, 3]
    pose[1, ..., [2, 4]] += 1.0
    return pose


def test_correlations_are_weighted_and_within_the_runs(dependent):
    log_weight = np.random.default_rng(1).normal(size=(2, DRAWS, 5))
    weights = weights_of_runs(log_weight)
    found = correlations(dependent, weights)
    for frame in range(5):
        covariance = sum(np.cov(dependent[run, :, frame].T, aweights=weights[run, :, frame], ddof=0) for run in range(2))
        scale = np.sqrt(np.diag(covariance))
        np.testing.assert_allclose(found[frame], covariance / np.outer(scale, scale), atol=1e-9)
    assert found[3, 1, 3] < -0.85 and abs(found[:, 2, 4]).max() < 0.2
    still = correlations(np.where(np.arange(5) == 2, 0.1, dependent), weights)
    assert np.isnan(still[:, 2]).all() and np.isfinite(still[:, 1, 3]).all()


def test_chance_is_not_a_dependence():
    """The adjusted square has mean 0 for independent normal draws."""
    rng, count = np.random.default_rng(2), 12
    r = np.array([np.corrcoef(rng.normal(size=(2, count)))[0, 1] for _ in range(2000)])
    assert np.mean(r**2) > 0.08
    assert abs(adjusted(r[None], np.array([[float(count)]])).mean()) < 0.01


def test_the_pair_that_trades_off_is_shown_in_its_frame(inspect, dependent, parse):
    it = inspect(pose=dependent, draws=DRAWS, ess=np.full((2, 5), float(DRAWS)))
    found = dependence(it)
    assert found.frame == 3 and found.pairs == [(1, 3)] and found.dofs == [1, 3]
    with style():
        page = parse(pair_section(it))
    (picture,) = page.of("img")
    assert "frame 3 (at 0.05 s)" in page.text and "left hip y and right elbow−0.9" in page.text
    assert picture["alt"].startswith("Scatter matrix of 2 dofs at frame 3. Correlations: left hip y and right elbow −0.9")


def test_independent_dofs_and_a_mode_seeker_have_a_sentence(inspect, parse):
    independent = parse(pair_section(inspect(pose=0.05 * np.random.default_rng(3).normal(size=(2, DRAWS, 5, 5)), draws=DRAWS)))
    seeker = parse(pair_section(inspect(log_evidence=np.full((2, 5), np.nan))))
    assert "No two dofs have a correlation of 0.3 or more" in independent.text and "mode seeker" in seeker.text
    assert not independent.of("img") and not seeker.of("img")


def test_the_dofs_are_those_of_the_strongest_pairs_that_fit():
    assert chosen_dofs([(7, 2), (4, 2), (5, 1), (8, 9), (1, 3)]) == [1, 2, 4, 5, 7]
    assert chosen_dofs([]) == []
