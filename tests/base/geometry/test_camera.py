"""The camera against OpenCV's, the lens's turning point, and derivatives."""

import cv2
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from bayes_body.base.geometry.camera import NEAR, Camera, project, turning_radius

ROTATION = cv2.Rodrigues(np.array([0.4, -1.1, 0.3]))[0]
TRANSLATION = np.array([0.2, -0.1, 3.0])
FOCAL, CENTRE = np.array([610.0, 590.0]), np.array([318.2, 243.7])
PLAIN = (0.0, 0.0, 0.0, 0.0, 0.0)
BODYTRACK = (-0.317, 0.139, 0.0, 0.0, 0.0)
ALL_FIVE = (-0.21, 0.11, 0.004, -0.003, -0.02)
TURNS = (-0.3, 0.0, 0.0, 0.0, 0.0)
# Turns back twice: the first time is what counts.
TWICE = (-0.9, 0.0, 0.0, 0.0, 0.4)


# One program for each form of the arguments, instead of one for each operation.
projected = jax.jit(project)
slopes = jax.jit(jax.vmap(jax.jacrev(lambda point, lens: project(lens, point)[0]), (0, None)))


@pytest.fixture
def x64():
    """Double precision."""
    with jax.enable_x64(True):
        yield


def camera(distortion=PLAIN, skew=0.0) -> Camera:
    """In the precision of the moment."""
    leaves = (ROTATION, TRANSLATION, FOCAL, CENTRE, skew, distortion, turning_radius(np.array(distortion)), (640.0, 480.0))
    return Camera(*(jnp.asarray(leaf, float) for leaf in leaves))


def to_world(in_camera: np.ndarray) -> np.ndarray:
    """Points given in the camera's frame, in the world's."""
    return (in_camera - TRANSLATION) @ ROTATION


def seen_points(count=1000) -> np.ndarray:
    """World points 1 to 6 m before the camera, over its whole image and a little more."""
    rng = np.random.default_rng(3)
    Z = rng.uniform(1, 6, count)
    return to_world(np.stack([rng.uniform(-0.6, 0.6, count) * Z, rng.uniform(-0.5, 0.5, count) * Z, Z], axis=1))


def opencv(points: np.ndarray, distortion) -> np.ndarray:
    K = np.array([[FOCAL[0], 0, CENTRE[0]], [0, FOCAL[1], CENTRE[1]], [0, 0, 1]])
    return cv2.projectPoints(points, cv2.Rodrigues(ROTATION)[0], TRANSLATION, K, np.array(distortion))[0][:, 0]


@pytest.mark.parametrize("distortion", [PLAIN, BODYTRACK, ALL_FIVE])
def test_equals_opencv_in_single_precision(distortion):
    pixels, visible = projected(camera(distortion), seen_points().astype(np.float32))
    assert pixels.dtype == jnp.float32
    assert visible.all()
    np.testing.assert_allclose(pixels, opencv(seen_points(), distortion), atol=1e-3)


@pytest.mark.parametrize("distortion", [PLAIN, BODYTRACK, ALL_FIVE])
def test_equals_opencv_in_double_precision(x64, distortion):
    pixels, _ = projected(camera(distortion), seen_points())
    np.testing.assert_allclose(pixels, opencv(seen_points(), distortion), atol=1e-9)


@pytest.mark.parametrize("distortion", [PLAIN, ALL_FIVE])
def test_skew_is_the_matrix_of_the_camera(x64, distortion):
    alpha, points = 0.013, seen_points()
    K = np.array([[FOCAL[0], alpha * FOCAL[0], CENTRE[0]], [0, FOCAL[1], CENTRE[1]], [0, 0, 1]])
    if distortion == PLAIN:
        bent = points @ ROTATION.T + TRANSLATION
    else:
        normalised = cv2.projectPoints(points, cv2.Rodrigues(ROTATION)[0], TRANSLATION, np.eye(3), np.array(distortion))[0][:, 0]
        bent = np.column_stack([normalised, np.ones(len(points))])
    homogeneous = bent @ K.T
    pixels, _ = projected(camera(distortion, alpha), points)
    np.testing.assert_allclose(pixels, homogeneous[:, :2] / homogeneous[:, 2:], atol=1e-9)


def test_viewpoint_is_the_origin_of_the_cameras_frame(x64):
    np.testing.assert_allclose(camera().viewpoint, to_world(np.zeros(3)), atol=1e-14)


def test_behind_is_not_visible():
    in_camera = np.array([[0.1, 0.1, 2.0], [0.1, 0.1, -2.0], [0.0, 0.0, NEAR / 2], [0.0, 0.0, -1e-3], [0.0, 0.0, 2 * NEAR]])
    pixels, visible = projected(camera(), to_world(in_camera).astype(np.float32))
    assert visible.tolist() == [True, False, False, False, True]
    assert np.isfinite(pixels).all()


def test_what_the_lens_folds_back_is_not_visible(x64):
    # At a radius of 1.8 the lens of k1 = -0.3 has turned: OpenCV puts the point into the image.
    point = to_world(np.array([[1.8 * 2.0, 0.0, 2.0]]))
    column = opencv(point, TURNS)[0, 0]
    assert 0 < column < 640
    pixels, visible = projected(camera(TURNS), point)
    np.testing.assert_allclose(pixels[0, 0], column, atol=1e-9)
    assert not visible[0]
    inside = to_world(np.array([[1.0 * 2.0, 0.0, 2.0]]))
    assert projected(camera(TURNS), inside)[1][0]


@pytest.mark.parametrize("distortion", [PLAIN, BODYTRACK, ALL_FIVE, TURNS, TWICE, (0.2, -0.05, 0.01, 0.01, 0.0)])
def test_turning_radius_against_a_search(distortion):
    k1, k2, _, _, k3 = distortion
    step, limit = 1e-4, 20.0
    r = np.arange(0, limit, step)
    falls = np.diff(r * (1 + k1 * r**2 + k2 * r**4 + k3 * r**6)) <= 0
    expected = r[np.argmax(falls)] if falls.any() else limit
    assert turning_radius(np.array(distortion), limit) == pytest.approx(expected, abs=2 * step)


def test_the_searched_lenses_are_of_both_kinds():
    assert turning_radius(np.array(TURNS)) == pytest.approx(np.sqrt(1 / 0.9))
    assert turning_radius(np.array(BODYTRACK)) == turning_radius(np.array(PLAIN)) == 1e3


@pytest.mark.parametrize("distortion", [PLAIN, BODYTRACK, ALL_FIVE])
def test_gradient_against_central_differences(x64, distortion):
    lens, points = camera(distortion, 0.01), seen_points(20)
    found = np.asarray(slopes(points, lens))
    step = 1e-5
    for axis in range(3):
        move = step * np.eye(3)[axis]
        ahead, behind = (np.asarray(projected(lens, points + sign * move)[0]) for sign in (1, -1))
        difference = (ahead - behind) / (2 * step)
        np.testing.assert_allclose(found[:, :, axis], difference, rtol=1e-6, atol=1e-4)


@pytest.mark.parametrize("depth", [0.0, 1e-12, -1e-12, NEAR, -3.0])
def test_gradient_is_finite_at_and_behind_the_plane_of_the_camera(depth):
    point = to_world(np.array([0.3, -0.2, depth])).astype(np.float32)
    assert np.isfinite(slopes(point[None], camera(ALL_FIVE))).all()
