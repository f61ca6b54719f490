"""One frame against the truth: distances that are known, and intervals that hold what they promise."""

import numpy as np
import pytest

from bayes_body.results.metrics.accuracy import LEVELS, SHARES, frame_accuracy, inside_intervals
from bayes_body.results.posterior.moments import weighted_quantiles

FIFTY, NINETY = LEVELS.index(0.5), LEVELS.index(0.9)
NAMES = ("pelvis", "l_knee", "head")


def even(count):
    return np.full(count, 1 / count)


def test_the_error_is_that_of_the_weighted_mean():
    positions = np.zeros((4, 1, 3))
    positions[:, 0, 0] = [0.0, 1.0, 2.0, 3.0]
    weights = np.array([0.1, 0.2, 0.3, 0.4])
    found = frame_accuracy(positions, weights, np.array([[2.0, 0.3, -0.4]]), NAMES[:1])
    np.testing.assert_allclose(found.error, 0.5)
    # The best particle is the third, whatever it weighs.
    assert found.optimistic == pytest.approx(0.5)
    # Distances from the mean at 2: 2, 1, 0, 1 m.
    np.testing.assert_allclose(found.expected, [0.0, 0.0, 1.0, 2.0], atol=1e-12)


def test_the_best_particle_has_a_weight_and_is_one_for_all_markers():
    positions = np.zeros((3, 2, 3))
    # Each of the first two is right about one marker, the last about both, but it is excluded.
    positions[0, 1, 2], positions[1, 0, 2] = 0.6, 0.4
    found = frame_accuracy(positions, np.array([0.5, 0.5, 0.0]), np.zeros((2, 3)), NAMES[:2])
    assert found.optimistic == pytest.approx(0.2)


def test_relative_is_pelvis_on_pelvis_and_the_pelvis_does_not_count():
    truth = np.random.default_rng(0).normal(size=(3, 3))
    moved = truth + np.array([0.3, 0.0, 0.4])
    found = frame_accuracy(moved[None], even(1), truth, NAMES)
    np.testing.assert_allclose(found.error, 0.5)
    assert found.relative == pytest.approx(0, abs=1e-12)
    moved[2, 1] += 0.2
    assert frame_accuracy(moved[None], even(1), truth, NAMES).relative == pytest.approx(0.1)
    truth[0, 1] = np.nan
    assert np.isnan(frame_accuracy(moved[None], even(1), truth, NAMES).relative)
    assert np.isnan(frame_accuracy(moved[None], even(1), np.roll(truth, -1, axis=0), ("l_knee", "head", "l_hip")).relative)


def test_what_is_unknown_counts_nowhere():
    rng = np.random.default_rng(1)
    positions, truth, weights = rng.normal(size=(50, 3, 3)), rng.normal(size=(3, 3)), rng.dirichlet(np.ones(50))
    truth[1, 2] = np.nan
    found = frame_accuracy(positions, weights, truth, NAMES)
    assert np.isnan(found.error[1]) and not found.inside[:, 1].any()
    without = frame_accuracy(positions[:, [0, 2]], weights, truth[[0, 2]], ("pelvis", "head"))
    np.testing.assert_allclose(found.error[[0, 2]], without.error)
    np.testing.assert_array_equal(found.inside[:, [0, 2]], without.inside)
    np.testing.assert_allclose((found.relative, found.optimistic), (without.relative, without.optimistic))
    nothing = frame_accuracy(positions, weights, np.full((3, 3), np.nan), NAMES)
    assert np.isnan([*nothing.error, nothing.relative, nothing.optimistic, *nothing.expected]).all() and not nothing.inside.any()


def test_intervals_are_those_of_the_weighted_quantiles():
    """Two sums without sorting, held against quantiles, ends included: the truth often is one of the particles."""
    rng = np.random.default_rng(2)
    for count in (1, 2, 7, 40):
        for _ in range(30):
            cloud, weights = rng.integers(-4, 5, (count, 2, 3)).astype(float), rng.dirichlet(np.ones(count))
            truth = rng.integers(-5, 6, (2, 3)).astype(float)
            ends = tuple(share for level in LEVELS for share in ((1 - level) / 2, (1 + level) / 2))
            quantiles = np.stack(weighted_quantiles(cloud.reshape(1, count, 6), weights[None], ends)).reshape(len(LEVELS), 2, 2, 3)
            expected = (quantiles[:, 0] <= truth) & (truth <= quantiles[:, 1])
            np.testing.assert_array_equal(inside_intervals(cloud, weights, truth), expected)


def test_each_axis_has_its_own_interval():
    rng = np.random.default_rng(3)
    cloud = rng.normal(size=(1000, 1, 3)) * [1.0, 2.0, 4.0] + [10.0, 20.0, 30.0]
    assert inside_intervals(cloud, even(1000), np.array([[10.0, 20.0, 30.0]]))[FIFTY].all()
    np.testing.assert_array_equal(inside_intervals(cloud, even(1000), np.array([[10.0, 10.0, 33.0]]))[NINETY], [[True, False, True]])
    np.testing.assert_array_equal(inside_intervals(cloud, even(1000), np.array([[10.0, 20.0, -30.0]]))[NINETY], [[True, True, False]])


def test_among_n_equal_particles_the_truth_is_inside_as_often_as_counted():
    """The truth one more draw, its rank is uniform on 0..100: of 101 ranks, 25 to 74 and 5 to 94 are inside."""
    cloud = np.random.default_rng(4).permutation(100).astype(float)
    inside = [inside_intervals(np.repeat(cloud, 3).reshape(100, 1, 3), even(100), np.full((1, 3), rank - 0.5)) for rank in range(101)]
    count = np.sum(inside, axis=0)
    assert (count[FIFTY] == 50).all() and (count[NINETY] == 90).all()


def test_of_weighted_draws_the_intervals_hold_what_they_promise():
    """Draws from a wide normal, off its centre, weighted to be those of a narrow one that the truth comes from: known coverage at every level."""
    rng, trials = np.random.default_rng(5), 2000
    share, unweighted = np.zeros(len(LEVELS)), np.zeros(len(LEVELS))
    for _ in range(trials):
        draws = rng.normal(1.0, 3.0, size=(500, 1, 1))
        log_weights = -0.5 * draws[:, 0, 0] ** 2 + 0.5 * ((draws[:, 0, 0] - 1) / 3) ** 2
        weights = np.exp(log_weights) / np.exp(log_weights).sum()
        truth = np.full((1, 3), rng.normal())
        share += inside_intervals(np.tile(draws, 3), weights, truth)[:, 0, 0]
        unweighted += inside_intervals(np.tile(draws, 3), even(500), truth)[:, 0, 0]
    level = np.array(LEVELS)
    # Some 150 draws are effective: the intervals are off by at most 1/150.
    error = 4 * np.sqrt(level * (1 - level) / trials) + 1 / 150
    assert (np.abs(share / trials - level) < error).all()
    assert (np.abs(unweighted / trials - level) > error)[NINETY]


def test_the_error_lies_where_the_run_expects_it():
    """The truth one more draw of a skewed cloud: its distance from the mean lies between the shares 0.05 and 0.95 in 90 of 100."""
    rng, trials = np.random.default_rng(6), 1000
    outer = inner = 0
    for _ in range(trials):
        cloud = rng.gamma(1.5, size=(401, 3, 3))
        found = frame_accuracy(cloud[1:], even(400), cloud[0], NAMES)
        low, first, third, high = found.expected
        outer, inner = outer + (low < found.error.mean() < high), inner + (first < found.error.mean() < third)
    assert SHARES == (0.05, 0.25, 0.75, 0.95)
    assert abs(outer / trials - 0.9) < 4 * np.sqrt(0.9 * 0.1 / trials) + 0.01
    assert abs(inner / trials - 0.5) < 4 * np.sqrt(0.25 / trials) + 0.01
