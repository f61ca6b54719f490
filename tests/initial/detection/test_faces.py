"""Faces in several views as detections of the head. The cascades themselves are OpenCV's; what they find is given here."""

import cv2
import numpy as np
import pytest
from initial.detection.people import JOINTS, SIZE, camera, mask, ring, scene

from bayes_body.initial.detection import faces
from bayes_body.initial.detection.faces import detect_faces, upright
from bayes_body.recording.readers.keypoints.triangulate import project

FACE = np.array([0.08, 0.0, 1.6])


def given(monkeypatch, cameras, looks):
    """Faces as the cascades would find them: a face 0.18 m wide in the views of `looks`."""

    def found(scene, view):
        if view in looks:
            side = 520 * 0.18 / np.linalg.norm(FACE - scene.viewpoints[view])
            yield faces.Face(view, project(cameras[view], FACE[None])[0], side, looks[view])

    monkeypatch.setattr(faces, "_faces", found)


def test_pictures_without_a_face_give_no_head():
    cameras = ring(3)
    found = detect_faces(scene(cameras, [mask(each) for each in cameras]))
    assert not found.parts and not found.landmarks
    assert found.notices == ("no face was found in any view",)


@pytest.mark.parametrize("roll", [0.0, 2.0, np.pi])
def test_pictures_are_turned_until_up_is_up(roll):
    spec = camera(0.3, roll=roll)
    picture = np.full((SIZE[1], SIZE[0], 3), 50, np.uint8)
    top, below = project(spec, np.array([[0, 0, 1.75], [0, 0, 1.55]], float))
    cv2.circle(picture, tuple(np.rint(top).astype(int).tolist()), 3, (255, 255, 255), -1)
    turned = upright(scene([spec], None, pictures=[picture]), 0)
    row, column = np.unravel_index(turned.picture[..., 0].argmax(), turned.picture.shape[:2])
    assert np.linalg.norm(turned.to_image(np.array([column, row], float)) - top) < 6
    matrix = np.vstack([turned.matrix, [0, 0, 1]])
    high, low = (np.linalg.solve(matrix, np.append(pixel, 1.0)) for pixel in (top, below))
    assert low[1] > high[1] and abs(low[0] - high[0]) < 0.2 * (low[1] - high[1])


def test_two_faces_meet_at_the_head_and_tell_where_it_looks(monkeypatch):
    cameras = [camera(0.6), camera(-0.6), camera(2.5)]
    given(monkeypatch, cameras, {0: 0, 1: 0})
    found = detect_faces(scene(cameras, None)).parts["head"]
    assert np.linalg.norm(found.positions[0] - (FACE - [faces.FRONT_M, 0, 0])) < 0.02
    assert found.rotations[0, :, 0] @ [1, 0, 0] > 0.99 and found.rotations[0, 2, 2] > 0.99


@pytest.mark.parametrize(("angle", "looks"), [(-1.2, 1), (1.2, -1)])
def test_a_profile_looks_aside(monkeypatch, angle, looks):
    # Seen from the right of a person who faces +x (a camera at -y), the face looks to the right of the picture.
    cameras = [camera(0.0), camera(angle)]
    given(monkeypatch, cameras, {0: 0, 1: looks})
    assert detect_faces(scene(cameras, None)).parts["head"].rotations[0, :, 0] @ [1, 0, 0] > 0.95


def test_faces_that_look_apart_or_whose_rays_miss_are_no_head(monkeypatch):
    cameras = [camera(0.0), camera(np.pi - 0.3)]
    given(monkeypatch, cameras, {0: 0, 1: 0})
    assert "no two" in detect_faces(scene(cameras, None)).notices[0]
    cameras = [camera(0.6), camera(-0.6)]
    given(monkeypatch, [cameras[1], cameras[0]], {0: 0, 1: 0})
    assert not detect_faces(scene(cameras, None)).parts or abs(detect_faces(scene(cameras, None)).parts["head"].positions[0, 1]) < 0.02


def test_a_face_in_one_view_is_paired_with_the_head_of_the_hull(monkeypatch):
    cameras = ring(4)
    given(monkeypatch, cameras, {0: 0})
    found = detect_faces(scene(cameras, [mask(each) for each in cameras]))
    assert np.linalg.norm(found.landmarks["head"].positions[0] - JOINTS["head"]) < 0.12
    towards = scene(cameras, None).viewpoints[0] * [1, 1, 0]
    assert found.parts["head"].rotations[0, :, 0] @ towards / np.linalg.norm(towards) > 0.95


def test_a_head_outside_the_foreground_is_dropped(monkeypatch):
    cameras = ring(4)
    given(monkeypatch, cameras, {0: 0, 3: 0})
    found = detect_faces(scene(cameras, [mask(each, at=(0.0, 1.0)) for each in cameras]))
    assert not found.parts
