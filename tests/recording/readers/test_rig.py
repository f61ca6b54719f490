"""Rigs: shipped, written by a user, of a session, of a Pose2Sim calibration; still and moving cameras."""

import re
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from bayes_body.base.errors import InputError
from bayes_body.recording.readers.rig import CameraPath, read_rig
from bayes_body.recording.readers.rig_schema import RigCameraTable
from bayes_body.recording.session.read import save_session
from bayes_body.recording.session.session import Session, View
from bayes_body.workshop.simulation.session_files import write_calibration

RIGS = Path(__file__).parents[3] / "models" / "rigs"
CAMERA = """
[[camera]]
name = "{name}"
size_px = [640, 480]
focal_px = 500.0
{place}
"""
AIMED = "position_m = [3.0, -2.0, 1.8]\nlook_at_m = [0.2, 0.1, 0.9]"
KEYFRAME = "[[camera.path]]\ntime_s = {}\nposition_m = [{}, -4.0, 1.5]\nlook_at_m = [0.0, 0.0, 1.0]\n"


def write(path, *cameras, head='title = "a rig"\nfps = 50\n'):
    path.write_text(head + "".join(CAMERA.format(name=name, place=place) for name, place in cameras))
    return path


def pixel(camera, point):
    K = np.array([[camera.focal_px[0], 0, camera.centre_px[0]], [0, camera.focal_px[1], camera.centre_px[1]], [0, 0, 1]])
    turned = cv2.Rodrigues(camera.rotation)[0]
    return cv2.projectPoints(np.array([[point]], float), turned, camera.translation_m, K, np.array(camera.distortion))[0].ravel()


def viewpoint(camera):
    return -camera.rotation.T @ camera.translation_m


@pytest.mark.parametrize(("name", "grey"), [("humaneva_7", 4), ("room_4", 0), ("side_1", 0), ("moving_1", 0)])
def test_shipped_rigs_film_60_frames_a_second_around_the_origin(name, grey):
    rig = read_rig(RIGS / f"{name}.toml")
    assert (rig.name, rig.fps, sum(rig.grey), len(rig.cameras)) == (name, 60.0, grey, int(name[-1]))
    np.testing.assert_allclose(rig.aim_m, (0, 0, 0.9), atol=0.05)
    for camera in rig.cameras:
        assert camera.size_px == (640, 480)
        assert 3.5 < np.hypot(*viewpoint(camera)[:2]) < 5.5
        # A person of 1.8 m anywhere within half a metre of the middle is in the picture, upright.
        ends = [pixel(camera, (x, y, z)) for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (0.0, 1.8)]
        assert all((end > 0).all() and (end < (640, 480)).all() for end in ends)
        assert pixel(camera, (0, 0, 1.8))[1] < pixel(camera, (0, 0, 0))[1] - 120


def test_a_camera_looks_where_it_is_told(tmp_path):
    (camera,) = read_rig(write(tmp_path / "rig.toml", ("a", AIMED))).cameras
    np.testing.assert_allclose(viewpoint(camera), (3, -2, 1.8), atol=1e-12)
    np.testing.assert_allclose(pixel(camera, (0.2, 0.1, 0.9)), (319.5, 239.5), atol=1e-9)
    np.testing.assert_allclose(camera.rotation @ camera.rotation.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(camera.rotation) == pytest.approx(1)
    # Seen from (3, -2), what lies towards (2, 3) is to the right.
    right = pixel(camera, np.array((0.2, 0.1, 0.9)) + 0.1 * np.array((2, 3, 0)))
    assert right[0] > 330
    assert right[1] == pytest.approx(239.5, abs=0.7)


def test_roll_turns_the_camera_clockwise(tmp_path):
    level, rolled = (read_rig(write(tmp_path / "rig.toml", ("a", AIMED + more))).cameras[0] for more in ("", "\nroll_deg = 90"))
    x, y = pixel(level, (0, 0, 1.2)) - 239.5 - np.array((80, 0))
    # A camera turned clockwise sees the world turned anticlockwise: what was above is on the left.
    np.testing.assert_allclose(pixel(rolled, (0, 0, 1.2)), (319.5 + y, 239.5 - x), atol=1e-6)


def test_a_moving_camera_passes_its_keyframes_smoothly_and_stands_outside_of_them():
    path = CameraPath(
        np.array([1.0, 2.0, 4.0]), np.array([[0, -4, 1.5], [2, -3, 1.6], [4, 0, 1.4]], float), np.tile((0, 0, 1.0), (3, 1)), np.zeros(3)
    )
    times = np.linspace(0, 5, 501)
    rotations, translations = path.extrinsics(times)
    places = -np.einsum("fba,fb->fa", rotations, translations)
    np.testing.assert_allclose(places[[100, 200, 400]], path.positions_m, atol=1e-9)
    assert (places[:100] == places[0]).all() and (places[401:] == places[400]).all()
    np.testing.assert_allclose(np.einsum("fab,fcb->fac", rotations, rotations), np.broadcast_to(np.eye(3), rotations.shape), atol=1e-12)
    speed = np.linalg.norm(np.diff(places, axis=0), axis=1) * 100
    # From rest to rest, without a jerk at the keyframe between.
    assert speed[101] < 0.2 and speed[398] < 0.2 and speed.max() > 2
    assert np.abs(np.diff(speed)).max() < 0.2


def test_a_rig_gives_each_camera_in_each_frame():
    rig = read_rig(RIGS / "moving_1.toml")
    (posed,) = rig.posed(241)
    np.testing.assert_allclose(viewpoint(posed[0]), (0.6, -4.4, 1.4), atol=1e-9)
    np.testing.assert_allclose(viewpoint(posed[240]), (4.4, -0.6, 1.4), atol=1e-9)
    assert posed[0] == rig.cameras[0]
    assert read_rig(RIGS / "room_4.toml").posed(2)[3] == [read_rig(RIGS / "room_4.toml").cameras[3]] * 2


def test_of_a_rig_some_cameras_can_be_taken():
    rig = read_rig(RIGS / "humaneva_7.toml")
    some = rig.select(["BW2", "C1"])
    assert [camera.name for camera in some.cameras] == ["C1", "BW2"]
    assert some.grey == (False, True)
    with pytest.raises(InputError, match="humaneva_7: camera 'C9': no such camera; known: BW1"):
        rig.select(["C1", "C9"])


def test_a_session_is_a_rig_whichever_axis_points_up(tmp_path):
    rig = read_rig(RIGS / "room_4.toml")
    turned = {"z": np.eye(3), "y": np.eye(3)[[1, 2, 0]], "x": np.eye(3)[[2, 0, 1]]}
    for up, R in turned.items():
        # The session's world x' = R x; its third axis, R's image of z, points up.
        assert (R @ (0, 0, 1)).tolist() == [float(axis == up) for axis in "xyz"]
        views = tuple(View(replace(camera, rotation=camera.rotation @ R.T), video="x.mp4") for camera in rig.cameras)
        save_session(Session(tmp_path / up, "a room", up, 25.0, 10, 0, views))
        found = read_rig(tmp_path / up)
        assert (found.fps, found.title) == (25.0, "a room")
        for camera, other in zip(found.cameras, rig.cameras, strict=True):
            np.testing.assert_allclose(camera.rotation, other.rotation, atol=1e-12)
        np.testing.assert_allclose(found.aim_m, (0, 0, 0.9), atol=0.02)


def test_a_pose2sim_calibration_is_a_rig(tmp_path):
    rig = read_rig(RIGS / "room_4.toml")
    write_calibration(tmp_path / "calibration" / "Calib.toml", rig.cameras)
    found = read_rig(tmp_path / "calibration" / "Calib.toml", fps=30.0)
    assert found.fps == 30.0
    for camera, other in zip(found.cameras, rig.cameras, strict=True):
        assert (camera.name, camera.size_px, camera.focal_px, camera.distortion) == (other.name, other.size_px, other.focal_px, other.distortion)
        np.testing.assert_allclose(camera.rotation, other.rotation, atol=1e-9)
        np.testing.assert_allclose(camera.translation_m, other.translation_m, atol=1e-9)


@pytest.mark.parametrize(
    ("place", "said"),
    [
        ("", "camera 'a': no place; expected position_m and look_at_m, rotation and translation_m, or"),
        ("position_m = [1, 2, 3]", "camera 'a': position_m without look_at_m; expected both; add look_at_m"),
        (AIMED + "\n" + KEYFRAME.format(0, 1) + KEYFRAME.format(1, 2), "camera 'a': 2 places; expected"),
        ("position_m = [1, 2, 3]\nlook_at_m = [1, 2, 3]", "look_at_m is where the camera stands; expected two different points"),
        ("position_m = [1, 2, 3]\nlook_at_m = [1, 2, 0]", "looks straight up or down; expected a view with a horizontal axis"),
        ("position_m = [3000, 2, 3]\nlook_at_m = [1, 2, 0]", "position_m #1: 3000; expected metres, at most 1000; it looks like millimetres"),
        (KEYFRAME.format(0, 1), "camera 'a': path has 1 keyframe; expected 2 or more"),
        (KEYFRAME.format(1, 1) + KEYFRAME.format(0.5, 2), "path goes from 1 s to 0.5 s; expected ascending times"),
        ("rotation = [[1, 0, 0], [0, 1, 0], [0, 0, 2]]\ntranslation_m = [0, 0, 4]", "rotation: not a rotation, R R^T is"),
        (AIMED + "\nfocal_px = -1", "key 'focal_px' is given twice"),
        (AIMED + "\nzoom = 2", "camera 'a'.zoom: unknown key"),
    ],
)
def test_what_is_wrong_with_a_camera_is_said(tmp_path, place, said):
    with pytest.raises(InputError) as error:
        read_rig(write(tmp_path / "rig.toml", ("a", place)))
    assert said in str(error.value)
    assert "rig.toml" in str(error.value)


def test_what_is_wrong_with_a_rig_is_said(tmp_path):
    for cameras, head, said in (
        ([("a", AIMED), ("A", AIMED)], 'title = "x"\nfps = 50\n', "camera 'a': 2 cameras have this name"),
        ([("a/b", AIMED)], 'title = "x"\nfps = 50\n', "'a/b'.name: \"a/b\"; expected letters, digits"),
        ([("a", AIMED)], 'title = "x"\nfps = 0\n', "fps = 0; expected a number greater than 0"),
        ([("a", AIMED)], 'title = "x"\nfps = 50\nup = "y"\n', 'up = "y"'),
        ([], 'title = "x"\nfps = 50\n', "camera: missing"),
    ):
        with pytest.raises(InputError) as error:
            read_rig(write(tmp_path / "rig.toml", *cameras, head=head))
        assert said in str(error.value)
    with pytest.raises(InputError, match="no such file"):
        read_rig(tmp_path / "other.toml")


def test_the_guides_rig_is_one_and_its_table_names_those_that_ship(tmp_path):
    guide = (Path(__file__).parents[3] / "docs" / "guide" / "simulate.md").read_text(encoding="utf-8")
    (example,) = re.findall(r"^```toml\n(.*?)^```$", guide, re.MULTILINE | re.DOTALL)
    (tmp_path / "rig.toml").write_text(example)
    rig = read_rig(tmp_path / "rig.toml")
    assert [camera.name for camera in rig.cameras] == ["left", "carried"]
    assert rig.grey == (False, True) and [path is None for path in rig.path] == [True, False]
    keys = re.findall(r"^\| `(\w+)`(?:, `(\w+)`)? \|", guide.split("| key of `[[camera]]`")[1].split("## What is written")[0], re.MULTILINE)
    assert {key for pair in keys for key in pair if key} == set(RigCameraTable.model_fields)
    assert set(re.findall(r"^\| `(\w+_\d)` \|", guide, re.MULTILINE)) == {path.stem for path in RIGS.glob("*.toml")}
