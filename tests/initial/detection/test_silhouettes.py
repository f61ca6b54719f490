"""The visual hull and its landmarks, on people of spheres in calibrated views."""

import numpy as np
import pytest
from initial.detection.people import JOINTS, PERSON, camera, mask, ring, scene

from bayes_body.initial.detection.hull import bodies, carve
from bayes_body.initial.detection.silhouettes import detect_silhouettes
from bayes_body.initial.detection.standing import detect_standing

BALL = (((0.3, -0.2, 0.9), (0.3, -0.2, 0.9), 0.25),)


def nearest(detections, place):
    return np.linalg.norm(detections.positions - np.array(place), axis=1).min()


def test_the_hull_of_a_ball_has_its_centre_and_about_its_volume():
    cameras = ring(6)
    (body,) = bodies(carve(cameras, [mask(each, BALL) for each in cameras]))
    assert np.linalg.norm(body.mean(axis=0) - [0.3, -0.2, 0.9]) < 0.03
    assert 1.0 < len(body) * 0.03**3 / (4 / 3 * np.pi * 0.25**3) < 1.25


def test_one_of_five_views_may_miss_the_ball_but_not_one_of_three():
    for count, found in ((5, 1), (3, 0)):
        cameras = ring(count)
        masks = [mask(each, BALL) for each in cameras]
        masks[0][:] = False
        assert len(bodies(carve(cameras, masks))) == found


def test_silhouettes_that_fill_the_images_say_nothing():
    cameras = ring(4)
    found = detect_silhouettes(scene(cameras, [np.ones((480, 640), bool)] * 4))
    assert not found.landmarks and found.person is None and "no body" in found.notices[0]


@pytest.fixture(scope="module", params=[4, 7])
def person(request):
    cameras = ring(request.param)
    return detect_silhouettes(scene(cameras, [mask(each, at=(0.4, -0.3)) for each in cameras]))


def test_every_joint_of_a_person_is_proposed(person):
    for name, place in JOINTS.items():
        limit = 0.06 if name in ("head", "thorax") else 0.1
        assert nearest(person.landmarks[name], np.add(place, (0.4, -0.3, 0.0))) < limit, name


def test_the_person_stands_where_they_stand(person):
    assert np.linalg.norm(person.person.floor_m - [0.4, -0.3, 0.0]) < 0.06
    assert abs(person.person.height_m - 1.75) < 0.06
    assert not person.person.facing_known


def test_detections_are_mixtures_of_rigid_poses(person):
    for each in (*person.landmarks.values(), *person.parts.values()):
        assert each.weights.sum() == pytest.approx(1.0) and (each.weights >= 0).all()
        assert (each.sd_m > 0).all() and (each.sd_rad > 0).all() and len(each.source) == len(each.weights)
    for each in person.parts.values():
        assert np.allclose(each.rotations @ each.rotations.transpose(0, 2, 1), np.eye(3), atol=1e-9)
        assert np.allclose(np.linalg.det(each.rotations), 1.0)
    assert (person.parts["torso"].rotations[:, 2, 2] > 0.95).all()


def test_forearms_lie_along_the_arms_that_are_held_aside(person):
    found, axis = person.parts["l_forearm"], np.array([0, 0.24, -0.18]) / 0.3
    near = np.linalg.norm(found.positions - [0.4, 0.52 - 0.3, 1.12], axis=1)
    assert near.min() < 0.1
    assert found.rotations[near.argmin(), :, 2] @ axis > 0.8


def test_left_and_right_get_the_same_detections(person):
    assert np.array_equal(person.landmarks["l_knee"].positions, person.landmarks["r_knee"].positions)


def test_another_axis_may_point_up():
    # The world is turned so that z becomes x: the same landmarks, turned.
    turn = np.array([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]])
    cameras = ring(4)
    masks = [mask(each) for each in cameras]
    turned = [type(c)(c.name, c.size_px, c.focal_px, c.centre_px, 0.0, c.distortion, c.rotation @ turn.T, c.translation_m) for c in cameras]
    found = detect_silhouettes(scene(turned, masks, up=0))
    assert nearest(found.landmarks["head"], turn @ JOINTS["head"]) < 0.06
    assert nearest(found.landmarks["l_ankle"], turn @ JOINTS["l_ankle"]) < 0.1


def test_a_wrong_axis_of_up_is_noticed_by_the_landmarks():
    cameras = ring(4)
    found = detect_silhouettes(scene(cameras, [mask(each) for each in cameras], up=1))
    assert "head" not in found.landmarks or nearest(found.landmarks["head"], JOINTS["head"]) > 0.2


def test_swapped_cameras_do_not_show_the_person():
    cameras = ring(5)
    masks = [mask(each, at=(0.8, 0.5)) for each in cameras]
    found = detect_silhouettes(scene([cameras[k] for k in (2, 0, 1, 4, 3)], masks))
    assert "head" not in found.landmarks or nearest(found.landmarks["head"], np.add(JOINTS["head"], (0.8, 0.5, 0.0))) > 0.2


def test_cameras_that_hang_upside_down_change_nothing():
    found = []
    for roll in (0.0, np.pi):
        cameras = ring(4, roll=roll)
        found.append(detect_silhouettes(scene(cameras, [mask(each) for each in cameras])))
    assert np.linalg.norm(found[0].landmarks["head"].positions[0] - found[1].landmarks["head"].positions[0]) < 0.04


def test_of_two_people_the_larger_is_taken_and_said():
    cameras = ring(6, distance=5.0)
    masks = [mask(each, at=(0.7, 0.7)) | mask(each, at=(-0.8, -0.6), size=0.75) for each in cameras]
    found = detect_silhouettes(scene(cameras, masks))
    assert np.linalg.norm(found.person.floor_m - [0.7, 0.7, 0.0]) < 0.08
    (notice,) = found.notices
    assert notice.startswith("two people: the one at (0.7, 0.7") and "largest" in notice


def test_a_shadow_on_the_floor_is_not_a_foot():
    cameras = ring(4)
    shadow = (*PERSON, ((0.3, 0.2, 0.02), (1.1, 0.8, 0.02), 0.03))
    found = detect_silhouettes(scene(cameras, [mask(each, shadow) for each in cameras]))
    assert np.linalg.norm(found.landmarks["l_ankle"].positions[:, :2], axis=1).max() < 0.6


def test_a_missing_head_is_proposed_where_the_stature_has_it():
    cameras = ring(4)
    masks = [mask(each, (PERSON[0], *PERSON[2:])) for each in cameras]
    found = detect_silhouettes(scene(cameras, masks, stature_m=1.8))
    assert nearest(found.landmarks["head"], JOINTS["head"]) < 0.1


def test_two_cameras_say_that_their_hull_is_broad():
    cameras = [camera(0.1), camera(1.6)]
    found = detect_silhouettes(scene(cameras, [mask(each) for each in cameras]))
    assert nearest(found.landmarks["head"], JOINTS["head"]) < 0.1
    assert any("two cameras" in notice for notice in found.notices)


def test_one_camera_tells_where_a_person_stands_on_the_floor():
    spec = camera(0.4, height=2.2)
    found = detect_standing(scene([spec], [mask(spec)], stature_m=1.75))
    assert np.linalg.norm(found.person.floor_m) < 0.35 and abs(found.person.height_m - 1.75) < 0.25
    assert set(found.landmarks) == {"pelvis", "thorax", "head"} and found.landmarks["head"].sd_m[0].min() >= 0.1
    assert "one camera" in found.notices[0]
    assert set(found.parts) == {"pelvis", "torso", "head"}
    torso = found.parts["torso"]
    assert abs(torso.positions[0, 2] - (0.9 + JOINTS["thorax"][2]) / 2) < 0.15 and np.allclose(torso.rotations[:, :, 2], (0, 0, 1))
    # All facings alike.
    assert np.allclose(torso.weights @ torso.rotations[:, :, 0], 0, atol=1e-9) and np.ptp(torso.weights) < 1e-9


def test_one_camera_takes_the_silhouette_that_stands_on_the_floor():
    spec = camera(0.4, height=2.2)
    person = mask(spec)
    # A larger one that floats above the horizon of the camera, beside the person.
    columns = np.flatnonzero(person.any(axis=0))
    both = person.copy()
    both[:150, : columns[0] - 5] = True
    assert both.sum() > 2 * person.sum()
    alone, found = (detect_standing(scene([spec], [each], stature_m=1.75)) for each in (person, both))
    np.testing.assert_allclose(found.person.floor_m, alone.person.floor_m)
    assert "2 silhouettes" in found.notices[1] and len(alone.notices) == 1


def test_one_camera_says_if_the_silhouette_is_no_standing_person():
    spec = camera(0.4, height=2.2)
    found = detect_standing(scene([spec], [mask(spec, BALL)], stature_m=1.75))
    assert not found.landmarks and "expected" in found.notices[0]
