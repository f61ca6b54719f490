"""Pose2Sim's and Anipose's toml: what is refused, and the real one."""

import numpy as np
import pytest

from bayes_body.base.errors import InputError
from bayes_body.recording.readers.calibration.toml import read_calibration_toml

SOUND = """\
[cam_01]
name = "left"
size = [640, 480]
matrix = [[600.0, 0.0, 320.0], [0.0, 610.0, 240.0], [0.0, 0.0, 1.0]]
distortions = [-0.1, 0.02, 0.0, 0.0]
rotation = [0.1, -0.2, 0.3]
translation = [100.0, 200.0, 3000.0]
fisheye = false

[metadata]
error = 0.0
"""


@pytest.fixture
def path(tmp_path):
    path = tmp_path / "Calib.toml"
    path.write_text(SOUND)
    return path


def test_units_and_names(path):
    (camera,) = read_calibration_toml(path, unit_m=1e-3)
    assert (camera.name, camera.size_px, camera.distortion) == ("left", (640, 480), (-0.1, 0.02, 0.0, 0.0, 0.0))
    np.testing.assert_allclose(camera.translation_m, [0.1, 0.2, 3.0])
    path.write_text(SOUND.replace('name = "left"\n', "").replace("fisheye = false\n", ""))
    assert read_calibration_toml(path)[0].name == "cam_01"


REFUSED = {
    "fisheye": ("fisheye = false", "fisheye = true", r"\[cam_01\]\.fisheye: true; expected a plain lens .*; calibrate again without the fisheye"),
    "text": ("[0.1, -0.2, 0.3]", '["a", 0.0, 0.0]', r'rotation #1 = "a"; expected a number'),
    "not finite": ("3000.0", "nan", "translation #3 = nan; expected a finite number"),
    "missing": ("rotation = [0.1, -0.2, 0.3]\n", "", "rotation: missing"),
    "short": ("[640, 480]", "[640]", "size"),
    "no focal length": ("600.0", "0.0", "focal length x = 0; expected a positive number"),
}


@pytest.mark.parametrize("fault", REFUSED)
def test_refused(path, fault):
    before, after, sentence = REFUSED[fault]
    assert before in SOUND
    path.write_text(SOUND.replace(before, after))
    with pytest.raises(InputError, match=f"^{path}: .*{sentence}") as error:
        read_calibration_toml(path)
    assert len(str(error.value).splitlines()) == 1


MATRIX = "[[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]]"


def test_what_is_no_camera_is_said(path):
    """A creation date, a board and a capture volume stand beside the cameras."""
    notes = []
    path.write_text('creation_date = "today"\n\n[charuco]\ncolumns = 4\n\n' + SOUND)
    assert [camera.name for camera in read_calibration_toml(path, note=notes.append)] == ["left"]
    assert notes == ["Calib.toml: creation_date, charuco: not cameras, and not read."]


def test_tables_below_cameras_have_numbers_matrices_and_perhaps_no_place(path):
    tables = SOUND.replace('name = "left"\n', "").replace("[metadata]\nerror = 0.0\n", "")
    first = tables.replace("[cam_01]", "[cameras.0]").replace("[0.1, -0.2, 0.3]", MATRIX)
    second = tables.replace("[cam_01]", "[cameras.1]").replace("rotation = [0.1, -0.2, 0.3]\ntranslation = [100.0, 200.0, 3000.0]\n", "")
    notes = []
    path.write_text(first + second)
    (camera,) = read_calibration_toml(path, note=notes.append)
    assert camera.name == "cam_0" and notes == ["Calib.toml: [cameras.1]: no rotation and translation, so this camera is left out."]
    np.testing.assert_allclose(camera.rotation, [[1, 0, 0], [0, 0, -1], [0, 1, 0]])
    path.write_text(second)
    with pytest.raises(InputError, match="no camera has a rotation and a translation: these are intrinsics only"):
        read_calibration_toml(path)


def test_no_camera(tmp_path):
    (tmp_path / "empty.toml").write_text("[metadata]\nerror = 0.0\n")
    with pytest.raises(InputError, match="no camera in it; expected a table for each camera"):
        read_calibration_toml(tmp_path / "empty.toml")


def test_real_file(sports2d_walk):
    (camera,) = read_calibration_toml(sports2d_walk / "calibration" / "Calib_demo.toml")
    assert (camera.name, camera.size_px) == ("demo", (1768, 994))
    np.testing.assert_allclose(camera.focal_px, 2520.09, atol=0.01)
    # It stands ten metres from the walker, looks level, and z is up.
    np.testing.assert_allclose(camera.rotation[2] @ [0, 0, 1], 0, atol=1e-6)
    np.testing.assert_allclose(camera.translation_m[2], 10.0)
