"""Bands hold what they promise: the level, ArviZ's own quantile, and any false rejection over a family."""

import numpy as np
import pytest
from arviz_stats.ecdf_utils import simulate_confidence_bands
from scipy import stats

from bayes_body.calibration import bands

BINS = 20


def _counts(rng, replications, quantities, bins=BINS):
    return rng.multinomial(replications, np.full(bins, 1 / bins), quantities)


def test_the_quantile_is_that_of_arviz():
    points = np.arange(1, BINS) / BINS
    theirs = simulate_confidence_bands(500, 1, points, 0.95, 8000, np.random.default_rng(1))
    ours = 1 - np.quantile(bands._null(500, BINS), 0.05)
    assert abs(ours - theirs) < 0.001


@pytest.mark.parametrize("replications", [30, 500])
def test_a_uniform_curve_lies_inside_as_often_as_the_band_says(replications):
    counts = _counts(np.random.default_rng(3), replications, 4000)
    band = bands.bands(replications, BINS, 0.9)
    curves = np.cumsum(counts, axis=1)[:, :-1] / replications
    inside = ((curves >= band.low - 1e-9) & (curves <= band.high + 1e-9)).all(axis=1).mean()
    # Whole numbers: the level is met or exceeded.
    assert 0.9 - 4 * np.sqrt(0.09 / 4000) < inside < 0.94


def test_p_values_and_bands_say_the_same():
    rng = np.random.default_rng(5)
    counts = np.stack([rng.multinomial(300, weights) for weights in rng.dirichlet(np.full(BINS, 60), 300)])
    band = bands.bands(300, BINS, 0.95)
    curves = np.cumsum(counts, axis=1)[:, :-1] / 300
    inside = ((curves >= band.low - 1e-9) & (curves <= band.high + 1e-9)).all(axis=1)
    assert 0.1 < inside.mean() < 0.95
    assert np.mean(inside == (bands.p_values(counts) > 0.05)) > 0.99


def test_p_values_of_uniform_ranks_are_no_smaller_than_they_say():
    p = bands.p_values(_counts(np.random.default_rng(7), 400, 3000))
    assert stats.kstest(p, "uniform", alternative="greater").pvalue > 0.01


@pytest.mark.parametrize("tilt", [np.linspace(0.85, 1.15, BINS), 1 + 0.2 * np.cos(np.linspace(0, 2 * np.pi, BINS))])
def test_ranks_that_lean_or_pile_up_are_found_out(tilt):
    counts = np.random.default_rng(9).multinomial(5000, tilt / tilt.sum(), 20)
    assert (bands.p_values(counts) < 0.001).all()


def test_a_family_rejects_falsely_as_seldom_as_promised():
    p = np.random.default_rng(11).uniform(size=(4000, 12))
    rejected = np.array([bands.holm(row).any() for row in p])
    assert 0.03 < rejected.mean() < 0.065
    level = 1 - bands.family_level(12)
    assert (rejected == (p <= level).any(axis=1)).all()


def test_holm_rejects_step_by_step():
    assert bands.holm(np.array([0.01, 0.02, 0.04, 0.9])).tolist() == [1, 0, 0, 0]
    assert bands.holm(np.array([0.012, 0.016, 0.024, 0.04])).tolist() == [1, 1, 1, 1]


def test_ranks_are_counted():
    counts = bands.rank_counts(np.array([[0, 3], [1, 3], [0, 2]]), 4)
    assert counts.tolist() == [[2, 1, 0, 0], [0, 0, 1, 2]]
