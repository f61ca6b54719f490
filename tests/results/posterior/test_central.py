"""The body that stands for a posterior: the mean of one cloud, a draw where the mean would lie between the draws."""

import numpy as np
import pytest

from bayes_body.model.build import body_of
from bayes_body.model.definition import load_definition
from bayes_body.results.posterior.central import DRAWS, central_pose, distances, lies_among, thinned

EVEN = np.full(100, 0.01)


def among(points, shares=EVEN):
    """Whether the mean of points (draw, number) lies among them; the last axis is one point's coordinates in turn."""
    every = np.concatenate([points, shares @ points[:, :] / shares.sum() * np.ones((1, 1))])
    apart = distances(every.reshape(len(every), -1, 3))
    return lies_among(apart[-1, :-1], apart[:-1, :-1], shares)


@pytest.mark.parametrize("size", [3, 30, 90])
def test_the_mean_of_one_cloud_lies_in_it_whatever_its_shape(size):
    rng = np.random.default_rng(size)
    widths = np.exp(rng.normal(size=size))
    for draw in (rng.normal, rng.standard_exponential, rng.uniform):
        assert among(draw(size=(100, size)) * widths)


@pytest.mark.parametrize("share", [0.5, 0.8])
def test_the_mean_of_two_clouds_that_stand_apart_does_not(share):
    rng = np.random.default_rng(0)
    apart = np.where(np.arange(100)[:, None] < 100 * share, 0.0, 10.0)
    points = apart + rng.normal(size=(100, 12))
    assert not among(points)
    # Clouds that overlap are one.
    assert among(0.1 * apart + rng.normal(size=(100, 12)))


def test_ten_runs_that_found_ten_poses_have_no_mean():
    rng = np.random.default_rng(1)
    assert not among(10 * np.repeat(rng.normal(size=(10, 12)), 10, axis=0) + 0.1 * rng.normal(size=(100, 12)))


def test_a_chain_that_stayed_where_it_was_is_no_dense_place():
    """Ten different draws, each ten times: as ten draws."""
    rng = np.random.default_rng(2)
    assert among(np.repeat(rng.normal(size=(10, 30)), 10, axis=0))
    assert among(np.ones((100, 30))) and not among(np.repeat(rng.normal(size=(4, 30)), 25, axis=0))


def test_thinned_draws_have_the_weights_of_all():
    weights = np.random.default_rng(3).exponential(size=1000) ** 3
    weights /= weights.sum()
    places, shares = thinned(weights)
    assert len(places) == DRAWS and np.isclose(shares.sum(), 1) and len(set(places[shares > 0])) == np.count_nonzero(shares)
    heavy = weights.argmax()
    assert abs(shares[places == heavy].sum() - weights[heavy]) <= 1 / DRAWS


def test_a_posterior_is_shown_by_its_mean_or_by_a_draw_of_its_heavier_mode():
    body = body_of(load_definition("arm"))
    rng = np.random.default_rng(4)
    poses = np.array([0.3, 0.2, 0.0, 1.0]) + 0.1 * rng.normal(size=(300, 4))
    weights = rng.exponential(size=300)
    central = central_pose(body, poses, weights)
    assert central.is_mean and np.allclose(central.pose, weights @ poses / weights.sum(), atol=1e-6)
    # The elbow bends here or there, and hardly ever half way; the first mode is the heavier one.
    poses[200:, 1] += 1.5
    central = central_pose(body, poses, np.ones(300))
    assert not central.is_mean and (central.pose == poses[:200]).all(axis=1).any()
