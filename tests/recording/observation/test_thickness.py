"""How thick a silhouette is, and the points that stand for it."""

import cv2
import numpy as np
import pytest

from bayes_body.recording.observation.silhouette_edges import local_thickness, spread_points


def test_a_disc_is_as_thick_as_its_radius():
    mask = cv2.circle(np.zeros((101, 101), np.uint8), (50, 50), 30, 1, cv2.FILLED) > 0
    thickness = local_thickness(mask)
    assert (thickness[~mask] == 0).all()
    # Its rim is a polygon of pixels: what the inscribed disc leaves out is thin.
    assert np.median(thickness[mask]) == pytest.approx(30.5, abs=1)


@pytest.mark.parametrize("wide", [4, 9, 20])
def test_a_bar_is_half_as_thick_as_it_is_wide(wide):
    mask = np.zeros((60, 200), bool)
    mask[20 : 20 + wide, 10:190] = True
    middle = local_thickness(mask)[20 : 20 + wide, 40:160]
    assert np.median(middle) == pytest.approx(wide / 2, abs=1)
    np.testing.assert_allclose(local_thickness(mask.T)[40:160, 20 : 20 + wide].T, middle, atol=1)


def test_a_silhouette_that_leaves_the_image_is_as_thick_as_it_is_seen_to_be():
    assert np.median(local_thickness(np.ones((40, 100), bool))) == pytest.approx(20, abs=1)


def person() -> np.ndarray:
    """A torso of 60 x 120 pixels with an arm of 12 x 120 beside it, and a gap of 8 between them."""
    mask = np.zeros((200, 160), bool)
    mask[40:160, 20:80] = True
    mask[40:160, 88:100] = True
    return mask


def test_an_arm_gets_the_share_of_its_length():
    points = spread_points(person(), 200) + np.array([80, 100])
    assert person()[points[:, 1].astype(int), points[:, 0].astype(int)].all()
    assert len(np.unique(points, axis=0)) == 200
    # By length each has half; by area the arm would have a sixth.
    assert 0.4 < (points[:, 0] >= 88).mean() < 0.55


def test_points_leave_no_gaps():
    """Half a hundred points: no stretch of the arm longer than a seventh of it goes without."""
    points = spread_points(person(), 50) + np.array([80, 100])
    rows = np.sort(points[points[:, 0] >= 88, 1])
    assert np.diff(np.concatenate([[40], rows, [160]])).max() < 120 / 7


def test_of_an_empty_silhouette_all_are_the_middle():
    assert (spread_points(np.zeros((10, 12), bool), 5) == 0).all()
    assert spread_points(np.ones((10, 12), bool), 0).shape == (0, 2)


def test_more_points_than_pixels_repeat():
    mask = np.zeros((10, 10), bool)
    mask[4, 5] = True
    assert (spread_points(mask, 3) == [0, -1]).all()
