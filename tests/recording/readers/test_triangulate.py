"""Triangulation: exact where the cameras agree, unmoved by one that is wrong; and the subject among several people."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from scipy.optimize import least_squares

from bayes_body.recording.readers.keypoints.person import choose_person
from bayes_body.recording.readers.keypoints.triangulate import project, reprojection_errors, triangulate
from bayes_body.recording.session.session import CameraSpec

LENS = (-0.2, 0.1, 0.003, -0.002, -0.01)


def cameras(count=4, skew=0.0) -> list[CameraSpec]:
    """Around the z axis, looking at it."""
    out = []
    for azimuth in np.linspace(0.2, 5.2, count):
        C = np.array([4 * np.cos(azimuth), 4 * np.sin(azimuth), 1.5])
        forward = np.array([0, 0, 0.9]) - C
        forward /= np.linalg.norm(forward)
        right = np.cross(forward, [0, 0, 1.0])
        right /= np.linalg.norm(right)
        R = np.stack([right, np.cross(forward, right), forward])
        out.append(CameraSpec(f"c{len(out)}", (1280, 960), (900.0, 880.0), (640.0, 470.0), skew, LENS, R, -R @ C))
    return out


def body(rng, place=(0.0, 0.0, 0.0), count=25) -> np.ndarray:
    return rng.uniform([-0.4, -0.4, 0.0], [0.4, 0.4, 1.8], (count, 3)) + place


def seen(rig, points, confidence=0.9) -> np.ndarray:
    return np.stack([np.column_stack([project(camera, points), np.full(len(points), confidence)]) for camera in rig])


def test_projects_as_opencv_does():
    (camera,) = cameras(1)
    points = body(np.random.default_rng(0))
    K = np.array([[900, 0, 640], [0, 880, 470], [0, 0, 1.0]])
    expected = cv2.projectPoints(points, cv2.Rodrigues(camera.rotation)[0], camera.translation_m, K, np.array(LENS))[0][:, 0]
    np.testing.assert_allclose(project(camera, points), expected, atol=1e-8)
    centre = -camera.rotation.T @ camera.translation_m
    behind = np.stack([centre - camera.rotation[2], np.full(3, np.nan)])
    np.testing.assert_array_equal(project(camera, behind), [[np.inf, np.inf], [np.nan, np.nan]])


@pytest.mark.parametrize("skew", [0.0, 0.01])
@pytest.mark.parametrize("count", [2, 4])
def test_exact_rays_meet_in_the_point(count, skew):
    rig, points = cameras(count, skew), body(np.random.default_rng(1))
    found = triangulate(rig, seen(rig, points))
    np.testing.assert_allclose(found.points_m, points, atol=1e-6)
    assert found.used.all()
    assert found.error_px.max() < 1e-3


def test_one_wrong_camera_is_left_out():
    rng, rig = np.random.default_rng(2), cameras()
    points = body(rng)
    pixels = seen(rig, points)
    wrong = rng.integers(0, 4, len(points))
    pixels[wrong, np.arange(len(points)), :2] += [150.0, -90.0]
    found = triangulate(rig, pixels)
    np.testing.assert_allclose(found.points_m, points, atol=1e-6)
    np.testing.assert_array_equal(found.used, np.arange(4)[:, None] != wrong)


def test_what_is_not_seen_has_no_say():
    rig, points = cameras(), body(np.random.default_rng(3))
    pixels = seen(rig, points)
    pixels[0, :5, :2] = np.nan
    pixels[1, :5] = 0.0
    pixels[:3, 5, 2] = 0.0
    found = triangulate(rig, pixels)
    np.testing.assert_allclose(np.delete(found.points_m, 5, axis=0), np.delete(points, 5, axis=0), atol=1e-6)
    assert not found.used[:2, :5].any() and not found.used[:, 5].any()
    # One camera alone gives no point.
    assert np.isnan(found.points_m[5]).all() and np.isnan(found.error_px[5])


def test_rays_that_pass_each_other_give_no_point():
    rig, points = cameras(2), body(np.random.default_rng(4))
    pixels = seen(rig, points)
    pixels[1, :, 1] += 300
    assert np.isnan(triangulate(rig, pixels).points_m).all()


def test_error_in_the_image_is_the_noise():
    # 2 C equations for 3 unknowns: the root mean square residual is sd sqrt((2 C - 3) / C), counted by camera.
    rng, rig = np.random.default_rng(5), cameras()
    points = body(rng, count=400)
    pixels = seen(rig, points)
    pixels[..., :2] += rng.normal(0, 2.0, pixels[..., :2].shape)
    errors = triangulate(rig, pixels).error_px
    assert np.sqrt((errors**2).mean()) == pytest.approx(2.0 * np.sqrt(5 / 4), rel=4 / np.sqrt(2 * 5 * 400))


def test_confidence_weighs():
    rig = cameras(3)
    points = np.array([[0.0, 0.0, 0.9]])
    pixels = seen(rig, points)
    pixels[2, :, 0] += 10
    sure, unsure = pixels.copy(), pixels.copy()
    unsure[2, :, 2] = 0.05
    error = [reprojection_errors(rig, triangulate(rig, each).points_m, pixels)[2, 0] for each in (sure, unsure)]
    assert error[1] > error[0]
    assert np.linalg.norm(triangulate(rig, unsure).points_m - points) < np.linalg.norm(triangulate(rig, sure).points_m - points)


def crowd(rng, rig, *bodies) -> list[np.ndarray]:
    """Several people in every camera, in an order of each camera's own, with noise."""
    views = np.stack([seen(rig, each) for each in bodies], axis=1)
    views[..., :2] += rng.normal(0, 3.0, views[..., :2].shape)
    return [view[rng.permutation(len(bodies))] for view in views]


def test_the_person_in_most_cameras_is_the_subject():
    rng, rig = np.random.default_rng(6), cameras()
    subject, bystander = body(rng), body(rng, (1.0, 0.8, 0.0))
    people = crowd(rng, rig, subject, bystander)
    # The bystander is seen by two cameras only.
    for c in (1, 3):
        people[c] = people[c][[int(np.argmin([np.abs(person[:, :2] - project(rig[c], subject)).mean() for person in people[c]]))]]
    chosen = choose_person(rig, people)
    assert chosen is not None
    for camera, among, place in zip(rig, people, chosen.places, strict=True):
        assert place is not None
        assert np.abs(among[place][:, :2] - project(camera, subject)).mean() < 4
    assert chosen.error < 0.02


def test_a_camera_that_does_not_see_the_subject():
    rng, rig = np.random.default_rng(7), cameras()
    people = crowd(rng, rig, body(rng))
    people[2] = seen(rig[2:3], body(rng, (-1.2, -0.9, 0.0)))
    people[3] = np.zeros((0, 25, 3))
    chosen = choose_person(rig, people)
    assert chosen is not None
    assert chosen.places == (0, 0, None, None)


def test_nobody_in_common():
    rng, rig = np.random.default_rng(8), cameras(2)
    people = [seen(rig[:1], body(rng)), seen(rig[1:], body(rng, (1.5, 1.0, 0.0)))]
    assert choose_person(rig, people) is None
    assert choose_person(rig, [np.zeros((0, 25, 3))] * 2) is None


def test_one_camera_takes_the_largest():
    (camera,) = cameras(1)
    near, far = body(np.random.default_rng(9), (1.5, 0.3, 0)), body(np.random.default_rng(9), (-2, -0.4, 0))
    people = np.concatenate([seen([camera], far), seen([camera], near)])
    chosen = choose_person([camera], [people])
    assert chosen is not None
    assert chosen.places == (1,)
    assert choose_person([camera], [np.full((1, 25, 3), np.nan)]) is None


def test_a_near_camera_counts_as_the_image_says():
    # Three cameras at 1.3, 4 and 9 m: the point is that of least error in the images. The plain equations, too fond of far rays, miss it.
    rng, rig = np.random.default_rng(10), cameras(3)
    rig = [
        replace(camera, translation_m=camera.translation_m + np.array([0, 0, further]), distortion=(0.0,) * 5)
        for camera, further in zip(rig, (-2.8, 0.0, 5.0), strict=True)
    ]
    points = rng.uniform([-0.1, -0.1, 0.8], [0.1, 0.1, 1.0], (20, 3))
    pixels = seen(rig, points, 1.0)
    pixels[..., :2] += rng.normal(0, 4.0, pixels[..., :2].shape)
    found = triangulate(rig, pixels, np.inf).points_m
    for k in range(len(points)):

        def residuals(point, k=k):
            return np.concatenate([project(camera, point[None])[0] - each[k, :2] for camera, each in zip(rig, pixels, strict=True)])

        best = least_squares(residuals, points[k]).x
        assert np.linalg.norm(found[k] - best) < 0.2 * np.linalg.norm(best - points[k]) + 1e-4
