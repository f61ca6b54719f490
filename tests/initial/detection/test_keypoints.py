"""Keypoints of several cameras as detections of landmarks and parts."""

import numpy as np
import pytest
from initial.detection.people import camera, ring, scene

from bayes_body.initial.detection.keypoints import detect_keypoints
from bayes_body.recording.readers.keypoints.triangulate import project

# A person who faces +x and stands at (0.5, 0.2); left is +y.
PLACES = {
    "l_shoulder": (0.5, 0.4, 1.4),
    "r_shoulder": (0.5, 0.0, 1.4),
    "l_elbow": (0.5, 0.45, 1.1),
    "l_wrist": (0.7, 0.45, 1.0),
    "l_hip": (0.5, 0.3, 0.92),
    "r_hip": (0.5, 0.1, 0.92),
    "l_knee": (0.55, 0.3, 0.5),
    "l_ankle": (0.5, 0.3, 0.08),
    "head": (0.5, 0.2, 1.75),
    "nose": (0.6, 0.2, 1.63),
    "l_ear": (0.5, 0.27, 1.64),
    "r_ear": (0.5, 0.13, 1.64),
}


def keypoints(spec):
    pixels = project(spec, np.array(list(PLACES.values()), float))
    return {name: (float(u), float(v), 0.9) for name, (u, v) in zip(PLACES, pixels, strict=True)}


@pytest.fixture(scope="module")
def found():
    cameras = ring(4)
    return detect_keypoints(scene(cameras, None, keypoints=[keypoints(each) for each in cameras]))


def test_landmarks_are_where_the_keypoints_meet(found):
    for name in ("l_shoulder", "l_wrist", "l_ankle", "head"):
        assert np.allclose(found.landmarks[name].positions, [PLACES[name]], atol=1e-3)
    assert np.allclose(found.landmarks["pelvis"].positions, [[0.5, 0.2, 0.92]], atol=1e-3)
    assert "nose" not in found.landmarks and "r_ankle" not in found.landmarks


def test_parts_point_from_proximal_to_distal_and_the_trunk_forward(found):
    axis = np.array(PLACES["l_wrist"]) - PLACES["l_elbow"]
    assert np.allclose(found.parts["l_forearm"].rotations[0, :, 2], axis / np.linalg.norm(axis), atol=1e-3)
    assert np.allclose(found.parts["torso"].rotations[0, :, 0], [1, 0, 0], atol=1e-2)
    assert np.allclose(found.parts["head"].rotations[0], np.eye(3), atol=1e-2)
    assert "r_forearm" not in found.parts


def test_keypoints_tell_the_facing(found):
    assert found.person.facing_known and np.allclose(found.person.facing, [1, 0, 0], atol=1e-2)
    assert found.person.height_m == pytest.approx(1.75, abs=0.01)


def test_errors_in_the_images_widen_the_detections(found):
    cameras = ring(4)
    moved = [{name: (u + 6 * (-1) ** k, v, c) for name, (u, v, c) in keypoints(each).items()} for k, each in enumerate(cameras)]
    wide = detect_keypoints(scene(cameras, None, keypoints=moved))
    assert wide.landmarks["l_ankle"].sd_m[0, 0] > 1.5 * found.landmarks["l_ankle"].sd_m[0, 0]


def test_a_swapped_camera_is_left_out(found):
    cameras = ring(5)
    seen = [keypoints(each) for each in cameras]
    seen[3] = keypoints(cameras[0])
    again = detect_keypoints(scene(cameras, None, keypoints=seen))
    assert np.allclose(again.landmarks["l_wrist"].positions, found.landmarks["l_wrist"].positions, atol=1e-3)


def test_one_camera_is_not_enough_and_says_so():
    spec = camera(0.2)
    found = detect_keypoints(scene([spec], None, keypoints=[keypoints(spec)]))
    assert not found.landmarks and "fewer than two cameras" in found.notices[0]
