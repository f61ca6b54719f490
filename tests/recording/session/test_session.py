"""A session's file: what is written is read again, and what is wrong in it is said with file, key, value and remedy."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from bayes_body.base.errors import InputError
from bayes_body.recording.session.read import load_session, save_session
from bayes_body.recording.session.session import CameraSpec, CameraUncertainty, Segmentation, Session, Subject, View

SOUND = """\
title = "one man"
up = "y"
fps = 25
frames = 3
first_frame = 7

[subject]
height_m = 1.8

[subject.motion_sd_deg]
hip = 4.0

[initial.angles_deg]
hip = -30.0

[initial.positions_m]
root_x = 0.25

[[camera]]
name = "left"
size_px = [640, 480]
focal_px = [600.0, 610.0]
centre_px = [319.5, 239.5]
rotation = [[0, 0, 1], [1, 0, 0], [0, 1, 0]]
translation_m = [0.1, -0.2, 4.5]
images = "left/%04d.png"

[[camera]]
name = "right"
size_px = [640, 480]
focal_px = [600.0, 610.0]
centre_px = [319.5, 239.5]
rotation = [[1, 0, 0], [0, 1, 0], [0, 0, 1]]
translation_m = [0.3, -0.4, 3.5]
images = "/far/right/%d.png"
"""


@pytest.fixture
def path(tmp_path) -> Path:
    """A sound session file."""
    path = tmp_path / "session.toml"
    path.write_text(SOUND)
    return path


def refused(path: Path, before: str, after: str) -> list[str]:
    """The sentences about the sound file in which `before` (once) is `after`."""
    assert before in SOUND
    path.write_text(SOUND.replace(before, after, 1))
    with pytest.raises(InputError) as error:
        load_session(path)
    sentences = str(error.value).splitlines()
    assert all(sentence.startswith(f"{path}: ") for sentence in sentences)
    return [sentence.removeprefix(f"{path}: ") for sentence in sentences]


def test_reads_radians_and_metres(path):
    session = load_session(path.parent)
    assert session == load_session(path)
    assert (session.up, session.fps, session.frames) == ("y", 25.0, 3)
    assert session.initial == {"hip": math.radians(-30), "root_x": 0.25}
    assert session.positions == {"root_x"}
    assert session.subject.motion_sd == {"hip": math.radians(4)}
    assert session.views[0].camera.distortion == (0, 0, 0, 0, 0)
    np.testing.assert_array_equal(session.views[0].camera.rotation[0], [0, 0, 1])


def test_frames_count_from_the_first_file(path):
    session = load_session(path)
    left, right = session.views
    assert session.image_path(left, 0) == path.parent / "left" / "0007.png"
    assert session.image_path(right, 2) == Path("/far/right/9.png")
    assert session.mask_path(left, 0) is None


def test_a_camera_with_a_video_and_one_that_started_earlier(path):
    path.write_text(SOUND.replace('images = "left/%04d.png"', 'video = "left.mp4"\nbackground = "empty.png"\noffset = -3', 1))
    session = load_session(path)
    left, right = session.views
    assert session.video_path(left) == path.parent / "left.mp4" and session.video_path(right) is None
    assert session.background_path(left) == path.parent / "empty.png"
    assert session.image_path(left, 0) is None
    assert (session.number(left, 5), session.number(right, 5)) == (9, 12)


def test_sources_of_images(path):
    line = 'images = "left/%04d.png"'
    (sentence,) = refused(path, line, "")
    assert sentence.startswith("camera 'left': neither images nor video; expected one of the two")
    (sentence,) = refused(path, line, f'{line}\nvideo = "left.mp4"')
    assert sentence.startswith("camera 'left': both images and video")
    (sentence,) = refused(path, line, f"{line}\noffset = -8")
    assert sentence.startswith("camera 'left'.offset: -8, so its frames would begin at number -1; expected 0 or later")


def test_first_keypoints_belong_to_a_camera(path):
    (sentence,) = refused(path, "[[camera]]", "[initial.keypoints_px.lefd]\nnose = [1, 2, 0.5]\n\n[[camera]]")
    assert sentence == "initial.keypoints_px.lefd: no camera of that name; did you mean 'left'?"


def test_uncertainties_are_small_and_a_delay_is_not_of_the_first_camera(path):
    line = "height_m = 1.8"
    for faulty, said in {
        "lengths_sd = { thigh = 14 }": "subject.lengths_sd.thigh = 14",
        "keypoint_offsets_m = { hip = [20.0, 0.0, 0.0] }": "it looks like millimetres",
        "keypoint_offsets_sd_m = { hip = [-0.1, 0.0, 0.0] }": "subject.keypoint_offsets_sd_m.hip",
    }.items():
        (sentence,) = refused(path, line, f"{line}\n{faulty}")
        assert said in sentence
    line = 'images = "left/%04d.png"'
    for faulty, said in {
        "turn_sd_deg = [0.1, 0.1, 90.0]": "camera 'left'.turn_sd_deg",
        "move_sd_m = [0.01, 0.01, 15.0]": "it looks like millimetres",
        "focal_sd = 10.0": "camera 'left'.focal_sd = 10",
        "delay_s = 20.0": "camera 'left'.delay_s = 20",
        "delay_sd_s = 0.01": "camera 'left'.delay_s: the first camera's clock is the recording's; expected no delay",
    }.items():
        (sentence,) = refused(path, line, f"{line}\n{faulty}")
        assert said in sentence


def test_sessions_differ_by_any_number(path):
    session = load_session(path)
    turned = replace(session.views[0].camera, rotation=np.eye(3))
    assert session != replace(session, views=(replace(session.views[0], camera=turned), session.views[1]))


angle = st.floats(-10, 10, allow_nan=False)


@settings(max_examples=30)
@given(angle, angle, st.floats(0.001, 2.9), st.floats(1e-9, 1.0), st.text(max_size=10))
def test_save_and_load_is_the_same(tmp_path_factory, hip, x, length, sd, title):
    # Angles and metres are rounded to 1e-9 on writing; what has been rounded once stays as it is.
    camera = CameraSpec("c", (4, 3), (1e3 + sd, 7.25), (x, hip), sd, (x, hip, sd, 0.0, 1e-12), np.eye(3)[[1, 2, 0]], np.array([x, hip, 999.0]))
    subject = Subject(
        "b", length, {"a b": length}, {"p": (length, 0.5)}, {"p": (sd, length)}, {"hip": 1e-6 + sd, "x": 1e-6 + sd}, {"p": (0.5, length)}
    )
    folder = tmp_path_factory.mktemp("session")
    subject = replace(
        subject, lengths_sd={"a b": 0.25}, keypoint_offsets_m={"hip": (0.01, x / 50, 0.0)}, keypoint_offsets_sd_m={"hip": (sd / 9, 0.0, 0.0)}
    )
    known = CameraUncertainty((0.01, sd / 9, 0.02), (sd, 0.01, length), 0.125, (1.5, sd))
    view = View(camera, "%03d.png", "m%03d.png", background="empty.mp4", offset=2, uncertainty=known)
    first = {
        "initial_markers": {"head": (hip, x, 1.5)},
        "initial_keypoints": {"c": {"l knee": (x, hip, 0.5)}},
        "fit_lengths": sd > 0.5,
        "fit_outline": x > 0,
    }
    segmentation = Segmentation(sd + 1, 7, sd > 0.5, hip > 0)
    session = Session(
        folder,
        title,
        "z",
        29.97,
        5,
        0,
        (view,),
        subject,
        {"hip": hip, "x": x},
        frozenset({"x"}),
        **first,
        segmentation=segmentation,
        truth="t.npz",
        calibration="calibration.toml",
    )
    once = load_session(save_session(session))
    assert once.initial == pytest.approx(session.initial, abs=1e-9)
    assert once.calibration_path == folder / "calibration.toml"
    for key, value in vars(known).items():
        assert getattr(once.views[0].uncertainty, key) == (value and pytest.approx(value, abs=1e-9))
    assert once.subject.lengths_sd == subject.lengths_sd
    assert once.subject.keypoint_offsets_m["hip"] == pytest.approx(subject.keypoint_offsets_m["hip"], abs=1e-9)
    assert once.subject.keypoint_offsets_sd_m["hip"] == pytest.approx(subject.keypoint_offsets_sd_m["hip"], abs=1e-9)
    assert once.subject.motion_sd == pytest.approx(subject.motion_sd, abs=1e-9)
    assert (once.title, once.views[0].camera.distortion) == (title, camera.distortion)
    np.testing.assert_allclose(once.views[0].camera.translation_m, camera.translation_m, atol=1e-9)
    assert once.initial_markers["head"] == pytest.approx((hip, x, 1.5), abs=1e-9)
    assert (once.initial_keypoints, once.segmentation, once.truth) == (session.initial_keypoints, segmentation, "t.npz")
    assert (once.views[0].background, once.views[0].offset, once.fit_lengths, once.fit_outline) == ("empty.mp4", 2, sd > 0.5, x > 0)
    assert load_session(save_session(once)) == once


def test_the_file_is_for_people(path):
    text = save_session(load_session(path)).read_text()
    assert 'up = "y" # the world\'s axis that points up' in text
    assert "hip = -30.0" in text
    assert "[initial.positions_m]\nroot_x = 0.25" in text
    assert "masks" not in text


def test_no_file(tmp_path):
    with pytest.raises(InputError, match=r"session.toml: no such file; expected a TOML file; check the path"):
        load_session(tmp_path)


def test_syntax_error_names_line_and_column(path):
    (sentence,) = refused(path, "fps = 25", "fps 25")
    assert sentence.startswith("line 3, column 5: expected '=' after a key")
    assert "`fps 25`" in sentence


def test_unknown_keys_name_the_nearest(path):
    assert refused(path, "fps =", "fsp =") == ["fps: missing; expected a number; add it.", "fsp: unknown key; did you mean 'fps'?"]
    assert refused(path, "focal_px", "focal_pix")[-1] == "camera 'left'.focal_pix: unknown key; did you mean 'focal_px'?"
    assert refused(path, "height_m", "heigth_m") == ["subject.heigth_m: unknown key; did you mean 'height_m'?"]
    assert refused(path, "[[camera]]", "[[kamera]]")[-1] == "kamera: unknown key; did you mean 'camera'?"


def test_wrong_numbers(path):
    assert refused(path, "600.0", "nan") == ["camera 'left'.focal_px #1 = nan; expected a finite number; write a number such as 0.5."]
    assert refused(path, "600.0", "0") == ["camera 'left'.focal_px #1 = 0; expected a number greater than 0; write a larger number."]
    assert refused(path, "fps = 25", 'fps = "25"') == ['fps = "25"; expected a number; write it without quotes, such as 0.5.']
    assert refused(path, "frames = 3", "frames = 2.5") == ["frames = 2.5; expected a whole number; write it without quotes, such as 5."]
    assert refused(path, "frames = 3", "frames = 0") == ["frames = 0; expected a number greater than or equal to 1; write a larger number."]
    assert refused(path, "[640, 480]", "[640]") == ["camera 'left'.size_px = [640]; expected 2 entries, not 1; add what is missing."]
    assert refused(path, "frames = 3", "frames = 100000000")[0].startswith("frames = 100000000; expected a number less than or equal to 1000000;")
    assert refused(path, "first_frame = 7", "first_frame = " + "9" * 4000)[0].startswith("first_frame = 999999")
    assert refused(path, "[640, 480]", "[640, 100000]")[0].startswith("camera 'left'.size_px #2 = 100000; expected a number less than")
    assert refused(path, "[640, 480]", "[20000, 20000]")[0].startswith(
        "camera 'left'.size_px: 20000 x 20000 pixels; expected at most 134217728 in all"
    )
    assert refused(path, 'up = "y"', 'up = "Y"') == ['up = "Y": no such choice; known: x, y, z']


@pytest.mark.parametrize(
    ("before", "after", "key", "value"),
    [
        ("4.5]", "4524.5]", "camera 'left'.translation_m #3", "4524.5"),
        ("height_m = 1.8", "height_m = 180", "subject.height_m", "180"),
        ("root_x = 0.25", "root_x = 1250.0", "initial.positions_m.root_x", "1250"),
    ],
)
def test_millimetres_are_recognised(path, before, after, key, value):
    (sentence,) = refused(path, before, after)
    assert sentence.startswith(f"{key}: {value}; expected metres")
    assert "it looks like millimetres, divide by 1000" in sentence


def test_rotations(path):
    (sentence,) = refused(path, "[0, 0, 1], [1, 0, 0]", "[0, 0, -1], [1, 0, 0]")
    assert sentence.startswith("camera 'left'.rotation: a reflection, det R = -1; expected a rotation")
    (sentence,) = refused(path, "[0, 0, 1]", "[0, 0, 1.001]")
    assert sentence.startswith("camera 'left'.rotation: not a rotation, R R^T is 0.002 away")
    # Six digits of a calibration file are enough.
    path.write_text(SOUND.replace("[[1, 0, 0], [0, 1, 0]", "[[0.866025, 0.5, 0], [-0.5, 0.866025, 0]"))
    load_session(path)


def test_cameras_that_do_not_fit_together(path):
    (sentence,) = refused(path, '"right"', '"left"')
    assert sentence == "camera 'left': 2 cameras have this name; expected unique names; rename all but one."
    (sentence,) = refused(path, 'images = "left/%04d.png"', 'images = "left/%04d.png"\nmasks = "m/%04d.png"')
    assert sentence.startswith("camera 'right'.masks: missing, others have masks; expected all or none")


IMAGES = 'images = "left/%04d.png"'
BLIND = {
    "focal_px: x = 1e-30: the camera sees nothing; expected 32 to 640000 pixels": ("[600.0, 610.0]", "[1e-30, 610.0]"),
    "focal_px: y = 1e+09: the camera sees nothing; expected 24 to 480000 pixels": ("[600.0, 610.0]", "[600.0, 1e9]"),
    "centre_px: x = 1e+07: the camera looks beside the scene; expected -6000 to 6640 pixels": ("[319.5, 239.5]", "[1e7, 239.5]"),
    "distortion: k1, k2, k3 = -300, 0, 0: the lens folds the picture 13 pixels from": (IMAGES, f"{IMAGES}\ndistortion = [-300, 0, 0, 0, 0]"),
    "distortion: k1, k2, k3 = 1e+300, 0, 0: the lens folds the picture 0 pixels from": (IMAGES, f"{IMAGES}\ndistortion = [1e300, 0, 0, 0, 0]"),
    "distortion: p1, p2 = 0, 300: the lens folds the picture 0.33 pixels from": (IMAGES, f"{IMAGES}\ndistortion = [0, 0, 0, 300, 0]"),
}


@pytest.mark.parametrize("fault", BLIND)
def test_a_camera_that_sees_nothing(path, fault):
    (sentence,) = refused(path, *BLIND[fault])
    assert sentence.startswith(f"camera 'left': {fault}")
    assert sentence.endswith("copy it from the calibration again")


def test_lenses_of_real_cameras(path):
    # A GoPro, a lens whose polynomial grows for ever, one with all three coefficients, a coefficient below what can be divided by.
    for distortion in ([-0.26, 0.09, 0.001, -0.001, -0.016], [0.4, 0.1, 0, 0, 0], [-0.45, 0.3, 0.004, 0.002, -0.15], [0, 0, 0, 0, 1e-320]):
        path.write_text(SOUND.replace(IMAGES, f"{IMAGES}\ndistortion = {distortion}"))
        assert load_session(path).views[0].camera.distortion == tuple(distortion)


def test_paths_are_one_line_of_text(path):
    (sentence,) = refused(path, "left/%04d.png", "le\\u0000ft/%04d.png")
    assert sentence.startswith("camera 'left'.images: 'le\\x00ft/%04d.png' has control characters; expected one line of text")


@pytest.mark.parametrize("pattern", ["left.png", "%04d/%04d.png", "%s.png", "50%/%04d.png", "left%099999999999d.png"])
def test_patterns_have_one_place_for_the_number(path, pattern):
    (sentence,) = refused(path, "left/%04d.png", pattern)
    assert sentence.startswith(f"camera 'left'.images: \"{pattern}\"; expected one placeholder for the frame number; write %d")


def test_a_dof_in_degrees_and_in_metres(path):
    (sentence,) = refused(path, "root_x", "hip")
    assert sentence == "'hip': given both in degrees and in metres; expected an angle or a position; remove one."


def test_a_folder_that_cannot_be_written(path):
    session = load_session(path)
    with pytest.raises(InputError, match="cannot be written"):
        save_session(replace(session, folder=path / "inside a file"))
