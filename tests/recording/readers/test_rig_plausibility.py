"""What is odd in a calibration is said without any keypoints, and of good rigs nothing is."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from simulated_rigs import LANDSCAPE, PORTRAIT, rig

from bayes_body.base.files.shipped import definitions_folder
from bayes_body.recording.readers.agreement.changes import POSES, turned
from bayes_body.recording.readers.agreement.plausibility import describe_implausible
from bayes_body.recording.readers.calibration.qualisys import read_qualisys
from bayes_body.recording.readers.parsec_files import read_calibration
from bayes_body.recording.readers.rig import read_rig

TOML = Path("Calib.toml")


def test_good_rigs_get_no_sentence():
    for seed in range(30):
        cameras = rig(2 + seed % 11, (LANDSCAPE, PORTRAIT)[seed % 2], seed=100 + seed)
        # Some hang upside down or stand on end.
        cameras = [turned(camera, c % 4) if seed % 3 == 0 else camera for c, camera in enumerate(cameras)]
        assert describe_implausible(cameras, TOML) == []
    for path in (definitions_folder() / "rigs").glob("*.toml"):
        assert describe_implausible(read_rig(path).cameras, path) == []
    # Pixels that are not square in any camera, as in some video formats, and pictures that were undistorted.
    wide = [replace(camera, focal_px=(1067.0, 1000.0), distortion=(0.0,) * 5) for camera in rig(3)]
    assert describe_implausible(wide, TOML) == []


def test_real_calibrations_get_no_sentence(data_dir):
    for name, cameras in {
        "bodytrack_4cam": lambda folder: [read_calibration(path).spec((640, 480)) for path in folder.glob("CALIB/*.cal")],
        "pose2sim_beam": lambda folder: [camera.spec(camera.size_px) for camera in read_qualisys(folder / "calibration" / "Calib.qca.txt")],
    }.items():
        assert describe_implausible(cameras(data_dir(name)), TOML) == []


ODD = {
    "exchanged centre": (
        {"centre_px": (355.0, 644.0)},
        "camera 'c1': the principal point is at (355, 644) in pictures of 1280 x 720, as if column and row of the principal point are exchanged",
    ),
    "larger pictures": ({"centre_px": (1281.0, 717.0)}, "as if the pictures have half the size of those of the calibration: .* --rig c1=half_size"),
    "focal lengths": ({"focal_px": (1100.0, 1000.0)}, "camera 'c1': its focal lengths 1100 and 1000 px differ by 10 %, those of the others by 0.4 %"),
    "tangential": ({"distortion": (-0.1, 0.0, 0.001, -0.073, 0.0)}, "camera 'c1': its tangential distortion is 0.073, that of the others 0.000"),
    "lonely": ({"rotation": None}, "camera 'c1': sees no place that another camera sees"),
}


@pytest.mark.parametrize("fault", ODD)
def test_an_odd_camera_is_named(fault):
    changes, sentence = ODD[fault]
    cameras = rig(4)
    if fault == "lonely":
        # It looks at the sky from above the room.
        changes = {"rotation": np.eye(3), "translation_m": np.array([0.0, 0.0, -12.0])}
    (described,) = describe_implausible([replace(camera, **changes) if c == 1 else camera for c, camera in enumerate(cameras)], TOML)
    assert all(part in described for part in sentence.split(" .* "))


def test_cameras_that_look_away_from_each_other_are_said_with_what_would_turn_them():
    (described,) = describe_implausible([POSES["opengl"].apply(camera) for camera in rig(4)], TOML)
    assert described.startswith("No two cameras see a common place: they would with --rig opengl (the cameras have the axes of OpenGL and Blender")


def test_distortions_that_were_divided_by_64_are_said_of_a_toml_only():
    lenses = [replace(camera, distortion=(-0.05, 0.14, 0.0006, -0.0004 * (c + 1), 0.0)) for c, camera in enumerate(rig(4))]
    divided = [replace(camera, distortion=tuple(value / 64 for value in camera.distortion)) for camera in lenses]
    assert describe_implausible(lenses, TOML) == []
    (described,) = describe_implausible(divided, TOML)
    assert described.startswith("Calib.toml: the distortion of every lens is far smaller than usual (k1 at most 0.0008): Pose2Sim's conversion")
    assert describe_implausible(divided, Path("room.qca.txt")) == []
