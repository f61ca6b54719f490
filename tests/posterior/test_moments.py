"""Weighted moments: closed forms, and angles that wind."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from bayes_body.posterior.moments import unwrapped, weighted_moments, weighted_quantiles


def normalised(weights):
    return weights / weights.sum(axis=1, keepdims=True)


def test_whole_weights_are_repetitions():
    rng = np.random.default_rng(0)
    counts = rng.integers(0, 4, size=30)
    values = rng.gamma(2.0, size=(1, 30, 2, 3))
    moments = weighted_moments(values, normalised(counts[None].astype(float)))
    repeated = np.repeat(values[0], counts, axis=0)
    assert np.allclose(moments.mean[0], repeated.mean(axis=0)) and np.allclose(moments.sd[0], repeated.std(axis=0))
    for found, share in ((moments.q05, 0.05), (moments.q95, 0.95)):
        assert np.array_equal(found[0], np.quantile(repeated, share, axis=0, method="inverted_cdf"))


def test_a_draw_of_no_weight_is_no_draw():
    values = np.array([[[1.0], [2.0], [1e9]]])
    moments = weighted_moments(values, np.array([[0.5, 0.5, 0.0]]))
    assert (moments.mean, moments.sd, moments.q05, moments.q95) == (1.5, 0.5, 1.0, 2.0)


def test_equal_weights_reach_a_share_in_spite_of_rounding():
    for count in (20, 100):
        weights = np.full((1, count), 1 / count)
        found = weighted_quantiles(np.arange(count, dtype=float)[None, :, None], weights, (0.05, 0.25, 0.5, 0.75, 0.95))
        assert np.array_equal(found.ravel(), count * np.array([0.05, 0.25, 0.5, 0.75, 0.95]) - 1)


def test_each_frame_has_its_own_weights():
    values = np.tile(np.arange(3.0)[None, :, None], (3, 1, 1))
    moments = weighted_moments(values, np.eye(3))
    assert np.array_equal(moments.mean[:, 0], [0, 1, 2]) and np.array_equal(moments.q95[:, 0], [0, 1, 2]) and not moments.sd.any()


@settings(deadline=None)
@given(st.floats(-20, 20), st.integers(0, 2**32 - 1))
def test_a_turn_more_changes_nothing(centre, seed):
    rng = np.random.default_rng(seed)
    angles = centre + rng.uniform(-1.5, 1.5, size=(1, 25, 1))
    weights = normalised(rng.uniform(0.1, 1.0, size=(1, 25)))
    assert np.allclose(unwrapped(angles, weights), angles)
    # A few draws a turn further: on the same turn as the others once unwrapped, up to a turn of all.
    turned = angles.copy()
    turned[0, :5] += 2 * np.pi
    difference = unwrapped(turned, weights) - angles
    assert np.allclose(difference, difference[0, 0, 0]) and np.allclose(difference / (2 * np.pi), np.round(difference / (2 * np.pi)), atol=1e-9)


def test_an_angle_that_winds_keeps_its_turns():
    walk = np.linspace(0, 30, 200)[:, None, None] + np.array([-0.2, 0.2])[None, :, None]
    weights = np.full((200, 2), 0.5)
    assert np.allclose(unwrapped(walk, weights).mean(axis=1)[:, 0], np.linspace(0, 30, 200))
