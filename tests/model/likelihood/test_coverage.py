"""The share of an image that a body covers, against OpenCV's filled polygons."""

from functools import partial

import cv2
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from bayes_body.model.body.solids import Samples
from bayes_body.model.likelihood.outlines import projected_area
from bayes_body.model.likelihood.patch_pixels import rig_pixels

GRID = (80, 60)
SCALE = 8

area_of = jax.jit(projected_area, static_argnums=3)
pixels_of = jax.jit(rig_pixels)


@partial(jax.jit, static_argnums=3)
def total_and_slope(body, rig, pose, grid):
    """The sum of the areas, and its gradient by the pose."""
    return jax.value_and_grad(lambda pose: projected_area(body, rig, pose, grid).sum())(pose)


def filled(scene, pose) -> np.ndarray:
    """The covered share of each image: the parts' quadrilaterals, filled at eight times the resolution."""
    parts = len(scene.body.topology.names)
    corners = Samples(*(jnp.asarray(np.tile(row, (parts, 1))) for row in ([0.0, 1, 1, 0], [-1.0, -1, 1, 1])))
    u, v, _ = pixels_of(scene.body, scene.rig, corners, pose)
    shares = []
    for c, (width, height) in enumerate(np.asarray(scene.rig.size, int)):
        mask = np.zeros((SCALE * height, SCALE * width), np.uint8)
        for polygon in np.stack([u[c], v[c]], axis=-1):
            # Pixel (0, 0) reaches from -1/2 to 1/2.
            cv2.fillConvexPoly(mask, np.rint((polygon + 0.5) * SCALE - 0.5).astype(np.int32), 1)
        shares.append(mask.mean())
    return np.array(shares)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["deutscher_31", "arm_4"])
@pytest.mark.parametrize("seed", range(3))
def test_equals_filled_polygons(scene, name, seed):
    one = scene(name, seed)
    expected = filled(one, one.pose)
    assert expected.min() > 0.003
    np.testing.assert_allclose(area_of(one.body, one.rig, one.pose, GRID), expected, rtol=0.1)


@pytest.mark.slow
def test_a_finer_grid_is_nearer(x64, scene):
    man = scene("deutscher_31")
    expected = filled(man, man.pose)
    coarse, fine = (np.abs(area_of(man.body, man.rig, man.pose, grid) - expected).max() for grid in ((40, 30), (320, 240)))
    assert fine < coarse
    # OpenCV also paints the pixels that an outline only touches.
    assert fine < 0.02 * expected.max()


def test_in_the_images_corner_and_outside(scene):
    man = scene("deutscher_31")
    for axis in (0, 1):
        assert np.all(np.asarray(area_of(man.body, man.rig, man.pose.at[axis].add(-60), GRID)) < 1e-3)


@pytest.mark.slow
def test_gradient_is_that_of_the_area(x64, scene):
    man, step = scene("deutscher_31"), 1e-6

    def area(pose):
        return total_and_slope(man.body, man.rig, jnp.asarray(pose), GRID)

    pose = np.asarray(man.pose)
    found = np.asarray(area(pose)[1])
    assert np.isfinite(found).all()
    for k in (0, 1, 4, 8, 20):
        move = step * np.eye(pose.size)[k]
        difference = (area(pose + move)[0] - area(pose - move)[0]) / (2 * step)
        assert found[k] == pytest.approx(float(difference), rel=1e-5, abs=1e-8)
    # Also where parts are behind a camera, and where quadrilaterals have no area.
    for elsewhere in (pose + 2.5 * np.eye(pose.size)[0], np.zeros_like(pose)):
        assert np.isfinite(area(elsewhere)[1]).all()
