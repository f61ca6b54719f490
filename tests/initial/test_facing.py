"""Which way a person faces, over several frames: turns are slow, people walk forwards, and the frames' own evidence counts."""

import numpy as np
import pytest

from bayes_body.initial.search.search import TRUST, shares_over_time, way_of

NAMES = ("pelvis", "l_hip", "r_hip")
UP = 2


def _way(angle, log_evidence, place=(0.0, 0.0, 1.0)):
    """A body that faces a direction, given in radians about z from x."""
    left = np.array([-np.sin(angle), np.cos(angle), 0.0])
    markers = np.asarray(place) + np.stack([np.zeros(3), 0.1 * left, -0.1 * left])
    return way_of(NAMES, markers[None], np.zeros(1), log_evidence, 1.0, UP)


def _both(angle, log_odds, place=(0.0, 0.0, 1.0)):
    return _way(angle, log_odds, place), _way(angle + np.pi, 0.0, place)


def test_the_facing_and_place_of_a_way_are_those_of_its_mean_body():
    way = _way(0.3, 0.0, (1.0, 2.0, 0.9))
    np.testing.assert_allclose(way.facing, [np.cos(0.3), np.sin(0.3), 0.0], atol=1e-12)
    np.testing.assert_allclose(way.place, (1.0, 2.0, 0.9))


def test_one_frame_has_the_shares_of_its_evidence():
    (shares,) = shares_over_time([_both(0.3, 2.0)], [0.0], UP)
    np.testing.assert_allclose(shares, [1 / (1 + np.exp(-2.0 * TRUST)), 1 / (1 + np.exp(2.0 * TRUST))])


def test_frames_near_in_time_outvote_one_that_is_wrong():
    frames = [_both(0.1 * k, -3.0 if k == 2 else 4.0) for k in range(5)]
    shares = shares_over_time(frames, [0.2 * k for k in range(5)], UP)
    assert all(each[0] > 0.9 for each in shares)
    # Frames far apart say nothing about each other.
    alone = shares_over_time(frames, [100.0 * k for k in range(5)], UP)
    assert alone[2][0] < 0.3


@pytest.mark.parametrize(("speed", "told"), [(1.2, True), (0.1, False)])
def test_a_walker_faces_where_they_walk_and_a_stander_anywhere(speed, told):
    frames = [_both(0.0, 0.0, (0.2 * k * speed, 0.0, 1.0)) for k in range(5)]
    shares = shares_over_time(frames, [0.2 * k for k in range(5)], UP)
    assert all((each[0] > 0.9) == told and abs(each.sum() - 1) < 1e-9 for each in shares)
    # Strong pictures of somebody who walks backwards win.
    backwards = [_both(0.0, -10.0, (0.2 * k * speed, 0.0, 1.0)) for k in range(5)]
    assert all(each[0] < 0.1 for each in shares_over_time(backwards, [0.2 * k for k in range(5)], UP))


def test_the_shares_are_those_of_the_sum_over_all_paths():
    rng = np.random.default_rng(0)
    frames = [tuple(_way(rng.uniform(0, 6), rng.normal(0, 2)) for _ in range(2)) for _ in range(4)]
    seconds = np.cumsum(rng.uniform(0.1, 0.4, 4)).tolist()
    shares = shares_over_time(frames, seconds, UP)
    weights = np.zeros((2,) * 4)
    for path in np.ndindex(weights.shape):
        log_weight = sum(TRUST * frames[t][k].log_evidence for t, k in enumerate(path))
        for t in range(3):
            concentration = 1 / (0.35**2 + (2.0 * (seconds[t + 1] - seconds[t])) ** 2)
            log_weight += concentration * (frames[t][path[t]].facing @ frames[t + 1][path[t + 1]].facing)
        weights[path] = np.exp(log_weight)
    weights /= weights.sum()
    for t in range(4):
        np.testing.assert_allclose(shares[t], weights.sum(axis=tuple(k for k in range(4) if k != t)), rtol=1e-9)


def test_a_frame_may_have_one_way():
    shares = shares_over_time([_both(0.0, 0.0), (_way(np.pi, 0.0),)], [0.0, 0.2], UP)
    assert shares[0][1] > 0.95 and shares[1] == pytest.approx([1.0])
