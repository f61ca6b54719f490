"""The p-values of ranks are exact: those of an enumeration, those of ArviZ's simulation, and no smaller than they say."""

from itertools import product
from math import factorial, prod

import numpy as np
import pytest
from arviz_stats.ecdf_utils import simulate_confidence_bands
from scipy import stats

from bayes_body.workshop.calibration import bands

BINS = 20


def _counts(rng, replications, quantities, bins=BINS):
    return rng.multinomial(replications, np.full(bins, 1 / bins), quantities)


@pytest.mark.parametrize(("total", "bins"), [(7, 3), (5, 4), (2, 2)])
def test_p_values_are_those_of_an_enumeration(total, bins):
    every = np.array([c for c in product(range(total + 1), repeat=bins) if sum(c) == total])
    chance = np.array([factorial(total) / prod(factorial(n) for n in c) / bins**total for c in every])
    least = bands._smaller_tails(total, bins)[np.cumsum(every, axis=1)[:, :-1], np.arange(bins - 1)].min(axis=1)
    enumerated = [chance[least <= one * (1 + 1e-9)].sum() for one in least]
    assert np.allclose(bands.p_values(every), enumerated, atol=1e-12)


def test_the_band_is_that_of_arviz():
    points = np.arange(1, BINS) / BINS
    theirs = simulate_confidence_bands(500, 1, points, 0.95, 8000, np.random.default_rng(1))
    assert abs(bands._p_value((1 - theirs) / 2, 500, BINS) - 0.05) < 4 * np.sqrt(0.05 * 0.95 / 8000)


@pytest.mark.parametrize("replications", [30, 400])
def test_p_values_of_uniform_ranks_are_no_smaller_than_they_say(replications):
    p = bands.p_values(_counts(np.random.default_rng(7), replications, 20_000))
    assert stats.kstest(p, "uniform", alternative="greater").pvalue > 0.01
    assert (p < 0.001).mean() < 0.002


@pytest.mark.parametrize("tilt", [np.linspace(0.85, 1.15, BINS), 1 + 0.2 * np.cos(np.linspace(0, 2 * np.pi, BINS))])
def test_ranks_that_lean_or_pile_up_are_found_out(tilt):
    counts = np.random.default_rng(9).multinomial(5000, tilt / tilt.sum(), 20)
    assert (bands.p_values(counts) < 0.001).all()


def test_ranks_are_counted():
    counts = bands.rank_counts(np.array([[0, 3], [1, 3], [0, 2]]), 4)
    assert counts.tolist() == [[2, 1, 0, 0], [0, 0, 1, 2]]
