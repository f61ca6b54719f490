"""Weighted moments: closed forms, and angles that wind."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from bayes_body.density.spaces import SE3, circle, numbered
from bayes_body.results.posterior.moments import moments_in, weighted_moments, weighted_quantiles


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


YAW = circle(("yaw",))


@settings(deadline=None)
@given(st.floats(-20, 20), st.integers(0, 2**32 - 1))
def test_a_turn_more_changes_nothing(centre, seed):
    rng = np.random.default_rng(seed)
    angles = centre + rng.uniform(-1.5, 1.5, size=(1, 25, 1))
    weights = normalised(rng.uniform(0.1, 1.0, size=(1, 25)))
    plain, found = weighted_moments(angles, weights), moments_in(YAW, angles, weights)
    for name in plain._fields:
        assert np.allclose(getattr(found, name), getattr(plain, name))
    # A few draws a turn further: the same moments, up to a turn of all.
    turned = angles.copy()
    turned[0, :5] += 2 * np.pi
    moved = moments_in(YAW, turned, weights)
    shift = moved.mean - plain.mean
    assert np.allclose(shift / (2 * np.pi), np.round(shift / (2 * np.pi)), atol=1e-9) and np.allclose(moved.sd, plain.sd)
    assert np.allclose(moved.q05 - plain.q05, shift) and np.allclose(moved.q95 - plain.q95, shift)


def test_angles_on_both_sides_of_the_half_turn():
    angles = np.radians([[[179.0], [-179.0]]])
    weights = np.array([[0.5, 0.5]])
    found = moments_in(YAW, angles, weights)
    assert np.allclose(np.abs(np.degrees(found.mean)), 180) and np.allclose(np.degrees(found.sd), 1)
    # As plain numbers they have the mean 0, on the other side, and a spread of 179 degrees.
    plain = moments_in(numbered("yaw", (1,)), angles, weights)
    assert np.allclose(plain.mean, 0) and np.allclose(np.degrees(plain.sd), 179)


def test_an_angle_that_winds_keeps_its_turns():
    walk = np.linspace(0, 30, 200)[:, None, None] + np.array([-0.2, 0.2])[None, :, None]
    assert np.allclose(moments_in(YAW, walk, np.full((200, 2), 0.5)).mean[:, 0], np.linspace(0, 30, 200))


def test_moments_of_placements_are_metres_and_rotation_vectors_from_the_mean():
    rng = np.random.default_rng(0)
    half = rng.normal(0.0, (0.3, 0.2, 0.1, 0.2, 0.1, 0.3), size=(500, 6))
    centre = SE3().retract(np.array([1.0, 2.0, 3.0, 1.0, 0, 0, 0]), np.array([0, 0, 0, 2.0, -1.0, 0.5]))
    # A cloud and its mirror image: the mean is the centre, the spreads are those of the tangent vectors.
    points = SE3().retract(centre, np.concatenate([half, -half]))[None]
    found = moments_in(SE3(), points, np.full((1, 1000), 1 / 1000))
    assert np.allclose(found.mean[0], [1, 2, 3, 0, 0, 0], atol=1e-9) and np.allclose(found.sd[0], half.std(axis=0, mean=0), rtol=1e-6)
