"""Scores against closed forms of the normal distribution, within standard errors; and figures that change if the weights are ignored."""

import numpy as np
import pytest
from scipy.stats import chi, norm

from bayes_body.results.metrics.calibration import (
    CERTAIN,
    NOMINAL,
    Scores,
    calibration_curves,
    calibration_errors,
    correlated_frames,
    error_by_certainty,
    tarp,
)
from bayes_body.results.metrics.scores import frame_scores

FRAMES, DRAWS, MARKERS = 400, 400, 6


def scores_of(width, weighted=False, seed=0):
    """Scores of a posterior of sd `width` where 1 is right. If weighted, draws have twice this sd and the weights make up for it."""
    rng, rows = np.random.default_rng(seed), []
    for _ in range(FRAMES):
        mean, spread = rng.normal(size=(MARKERS, 3)), width * (2 if weighted else 1)
        draws = spread * rng.normal(size=(DRAWS, MARKERS, 3))
        # Weights of all markers together would leave a few draws: only the first marker is drawn wider.
        draws[:, 1:] *= width / spread
        log_weights = (norm.logpdf(draws[:, 0], scale=width) - norm.logpdf(draws[:, 0], scale=spread)).sum(axis=-1)
        weights = np.exp(log_weights) / np.exp(log_weights).sum()
        rows.append([frame_scores(mean + draws, weights, np.zeros((MARKERS, 3)), rng.normal(size=(MARKERS, 3)))])
    return Scores(*(np.array([[getattr(run, name) for run in row] for row in rows]) for name in Scores._fields))


# The mean distance of an empirical distribution of so many trials from the true one: sqrt(L (1 - L) / n) on average, and half as much again.
NOISE = 1.5 * np.sqrt(NOMINAL * (1 - NOMINAL) / FRAMES).mean()
# The spread of the truth around the mean, as the draws of a calibrated posterior see it.
UNIFORM_SD = np.sqrt(1 / 12 / FRAMES)


@pytest.mark.parametrize(("width", "verdict"), [(1.0, "about right"), (0.5, "too narrow"), (2.0, "too wide")])
def test_of_normal_draws_calibration_is_known(width, verdict):
    """The truth's distance has the chi distribution of three degrees of freedom, the draws' distances `width` times that."""
    scores = scores_of(width)
    curve = chi.cdf(width * chi.ppf(NOMINAL, 3), 3)
    # 400 draws move a quantile by less than a sixth of what 400 truths do in the mean.
    assert np.abs(calibration_curves(scores.level)[:-1] - curve[:-1, None]).max() < 4.5 * np.sqrt(0.25 / FRAMES)
    np.testing.assert_allclose(calibration_errors(scores.level), np.abs(curve - NOMINAL).mean(), atol=2 * NOISE)
    joint = tarp(scores.rank, np.random.default_rng(1).normal(size=(FRAMES, 1)))
    assert joint is not None and joint.verdict == verdict
    assert joint.sd == pytest.approx(np.sqrt(joint.level * (1 - joint.level) / joint.frames))
    if width == 1:
        assert abs(scores.rank.mean() - 0.5) < 4 * UNIFORM_SD


@pytest.mark.parametrize("width", [1.0, 0.5])
def test_crps_is_that_of_a_normal_distribution(width):
    """For N(m, s²) it is s (y (2 Φ(y) - 1) + 2 φ(y) - 1 / sqrt(pi)), y = (z - m) / s (Gneiting & Raftery 2007); its mean over normal z is known."""
    scores = scores_of(width)
    # E|z - x| = sqrt(2 (1 + s²) / pi), less half of E|x - x'| = 2 s / sqrt(pi).
    expected = np.sqrt(2 * (1 + width**2) / np.pi) - width / np.sqrt(np.pi)
    single = scores.crps.ravel()
    assert abs(single.mean() - expected) < 4 * single.std() / np.sqrt(single.size)


def test_few_draws_have_the_mean_crps_of_many():
    """The fair form: three draws of the right distribution have its mean score. The other form would be larger by half the mean difference over 3."""
    rng, trials = np.random.default_rng(3), 4000
    crps = np.array(
        [frame_scores(rng.normal(size=(3, 1, 3)), np.full(3, 1 / 3), rng.normal(size=(1, 3)), np.zeros((1, 3))).crps for _ in range(trials)]
    )
    expected, error = 1 / np.sqrt(np.pi), crps.std() / np.sqrt(trials)
    assert abs(crps.mean() - expected) < 4 * error and 1 / np.sqrt(np.pi) / 3 > 8 * error


def test_weights_count():
    """Draws that are twice too wide, with weights that make up for it: without the weights, the first marker would be too wide."""
    weighted, narrow = scores_of(1.0, weighted=True), scores_of(2.0)
    assert calibration_errors(weighted.level)[0] < 3 * NOISE < calibration_errors(narrow.level)[0] / 2
    # The spread is that of the weighted draws, whose effective number is about a third of them.
    assert weighted.spread[..., 0].mean() == pytest.approx(np.sqrt(3), rel=0.05)
    expected, single = 1 / np.sqrt(np.pi), weighted.crps[..., 0].ravel()
    assert abs(single.mean() - expected) < 4 * single.std() / np.sqrt(single.size)
    assert abs(weighted.rank.mean() - 0.5) < 4 * UNIFORM_SD
    # A draw of weight 0 changes nothing.
    rng = np.random.default_rng(5)
    draws, truth, noise = rng.normal(size=(40, 2, 3)), rng.normal(size=(2, 3)), rng.normal(size=(2, 3))
    some = rng.dirichlet(np.ones(39))
    for a, b in zip(frame_scores(draws, np.append(some, 0), truth, noise), frame_scores(draws[:-1], some, truth, noise), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-9)


def test_a_level_is_that_of_the_weighted_quantile_and_the_unknown_is_left_out():
    draws = np.zeros((4, 2, 3))
    draws[:, 0, 0] = [-1.0, 0.0, 0.5, 3.0]
    weights = np.array([0.2, 0.4, 0.3, 0.1])
    # The coordinate median is at 0; the distances are 1, 0, 0.5 and 3.
    for x, level in ((0.2, 0.4), (0.7, 0.7), (2.0, 0.9), (-4.0, 1.0)):
        found = frame_scores(draws, weights, np.array([[x, 0, 0], [np.nan, 0, 0]]), np.zeros((2, 3)))
        assert found.level[0] == pytest.approx(level)
        # CRPS: the mean distance, less the mean difference of two different draws; two of the three axes have none.
        distance = weights @ np.abs(draws[:, 0, 0] - x)
        differences = weights @ np.abs(draws[:, None, 0, 0] - draws[None, :, 0, 0]) @ weights / 2 / (1 - weights @ weights)
        assert found.crps[0] == pytest.approx((distance - differences) / 3)
        assert all(np.isnan(values[1]) for values in (found.level, found.crps, found.spread))
    nothing = frame_scores(draws, weights, np.full((2, 3), np.nan), np.zeros((2, 3)))
    assert all(np.isnan(values).all() for values in nothing)


def test_correlated_frames_are_thinned():
    """An autoregression of coefficient a has the autocorrelation time (1 + a) / (1 - a)."""
    rng, error = np.random.default_rng(2), np.zeros((4000, 2))
    for frame in range(1, 4000):
        error[frame] = 0.8 * error[frame - 1] + rng.normal(size=2)
    # A run that is worse throughout is no correlation.
    assert 7 <= correlated_frames(error + np.array([0, 50])) <= 11
    assert correlated_frames(rng.normal(size=(4000, 1))) <= 2
    assert correlated_frames(np.ones((10, 1))) == correlated_frames(np.ones((1, 1))) == 1
    ranks = rng.uniform(size=(4000, 2))
    assert 4000 / 11 <= tarp(ranks, error).frames <= 4000 / 7
    ranks[4:] = np.nan
    assert tarp(ranks, error) is None


def test_the_error_of_the_most_certain_frames():
    """Spread in the order of the error, and in the opposite one; each run is sorted by its own."""
    error = np.arange(1.0, 11)[:, None, None] * np.ones((1, 2, 3))
    spread = error.copy()
    spread[:, 1] = -error[:, 1]
    lower, upper = np.arange(1.0, 11), np.arange(10.0, 0, -1)
    counts = np.arange(1, 11)
    np.testing.assert_allclose(error_by_certainty(error, spread), (np.cumsum(lower) + np.cumsum(upper)) / 2 / counts)
    unknown = error.copy()
    unknown[3] = np.nan
    assert error_by_certainty(unknown, error)[-1] == pytest.approx((55 - 4) / 9)
    assert np.isnan(error_by_certainty(np.full((3, 1, 2), np.nan), np.ones((3, 1, 2)))).all() and len(CERTAIN) == 10
