"""A person's stature by triangulated keypoints, and the units that it contradicts."""

import numpy as np
import pytest
from body_figures import figures

from bayes_body.base.errors import InputError
from bayes_body.recording.readers.keypoints.openpose import LAYOUTS
from bayes_body.recording.readers.keypoints.stature import Stature, check_stature, measure_stature, triangulated_body
from bayes_body.recording.readers.keypoints.triangulate import project
from bayes_body.recording.session.session import CameraSpec


def ring(count, radius_m):
    """Cameras around the origin that look at it, y up."""
    cameras = []
    for k in range(count):
        angle = 0.4 + 2 * np.pi * k / max(count, 3)
        forward = -np.array([np.cos(angle), 0, np.sin(angle)])
        right = np.cross(forward, [0, 1, 0])
        R = np.stack([right, np.cross(forward, right), forward])
        cameras.append(CameraSpec(f"cam{k}", (640, 480), (600.0, 600.0), (320.0, 240.0), 0.0, (0.0,) * 5, R, np.array([0, 0, radius_m])))
    return cameras


def seen(height_m, cameras, layout="COCO_17", wrong=0.0):
    """Keypoints (camera, frame, keypoint, 3) of a walking person whose middle is at the origin."""
    rng = np.random.default_rng(2)
    points = figures(layout, 20, height_m) - [0, height_m / 2, 0]
    pixels = np.stack([project(camera, points.reshape(-1, 3)).reshape(*points.shape[:2], 2) for camera in cameras])
    pixels += rng.normal(0, 1, pixels.shape)
    pixels = np.where(rng.random(pixels.shape[:3])[..., None] < wrong, rng.uniform(0, 480, pixels.shape), pixels)
    return np.concatenate([pixels, np.full((*pixels.shape[:3], 1), 0.9)], axis=-1)


@pytest.mark.parametrize("height_m", [0.06, 0.9, 1.7, 17.0])
@pytest.mark.parametrize("layout", ["COCO_17", "BODY_25"])
def test_the_stature_is_measured_in_any_size(height_m, layout):
    cameras = ring(3, 2.5 * height_m)
    for wrong in (0.0, 0.2):
        stature = measure_stature(triangulated_body(cameras, seen(height_m, cameras, layout, wrong)), LAYOUTS[layout])
        assert stature is not None and stature.stature_m == pytest.approx(height_m, rel=0.05)
    assert measure_stature(triangulated_body(cameras[:1], seen(height_m, cameras[:1], layout)), LAYOUTS[layout]) is None


def test_points_that_are_no_body_have_no_stature():
    cameras = ring(3, 4.0)
    shuffled = seen(1.7, cameras)[:, :, np.random.default_rng(0).permutation(17)]
    assert measure_stature(triangulated_body(cameras, shuffled), LAYOUTS["COCO_17"]) is None


GOOD = [(1.7, None), (0.8, None), (2.2, None), (0.65, 0.62), (1.5, 1.75), (1.0, 1.1)]


@pytest.mark.parametrize(("stature_m", "height_m"), GOOD)
def test_children_babies_and_giants_are_people(stature_m, height_m):
    assert check_stature(Stature(stature_m, {}), height_m, "m") == []
    assert check_stature(None, height_m, "m") == []


BAD = [
    (17.2, None, "cm", r"17.2 m tall .*; expected 0.75 to 2.3 m; with --unit mm it would be 1.72 m"),
    (0.17, None, "mm", r"0.17 m tall .*; with --unit cm it would be 1.7 m"),
    (0.66, None, "cm", r"with --unit in it would be 1.68 m; if it is a baby, give --height"),
    (0.066, 1.7, "mm", r"expected 1.7 m, as --height says; with --unit in it would be 1.68 m"),
    (5.1, None, "m", r"no unit makes it a person: .* squares of a board"),
    (5.1, None, None, r"name the calibration of this recording"),
    (0.3, 1.8, None, r"expected 1.8 m, as --height says"),
]


@pytest.mark.parametrize(("stature_m", "height_m", "unit", "sentence"), BAD)
def test_a_wrong_unit_is_named(stature_m, height_m, unit, sentence):
    with pytest.raises(InputError, match=rf"^stature: the person is .*{sentence}"):
        check_stature(Stature(stature_m, {"thigh": 0.245 * stature_m}), height_m, unit)


def test_a_height_that_is_contradicted_is_said():
    (remark,) = check_stature(Stature(1.2, {"thigh": 0.3}), 1.8, "m")
    assert remark == "--height 1.8: the person is 1.2 m tall by these keypoints (thigh 0.3 m): check the height, and the unit of the calibration."
