"""A moving camera's file: read back row by row, and refused in a sentence where it cannot be used."""

from pathlib import Path

import numpy as np
import pytest

from bayes_body.base.errors import InputError
from bayes_body.recording.readers.camera_path import cameras_at, read_camera_path
from bayes_body.recording.session.session import CameraSpec, Session, View


def turned(angle):
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])


ROTATIONS = np.stack([turned(0.1 * k) for k in range(5)])
TRANSLATIONS = np.arange(15.0).reshape(5, 3)


def written(folder: Path, rotation=ROTATIONS, translation_m=TRANSLATIONS, **more) -> Path:
    path = folder / "moving.npz"
    np.savez(path, **{"rotation": rotation, "translation_m": translation_m} | more)
    return path


def test_each_frame_has_its_own_row_and_a_still_camera_stays(tmp_path):
    written(tmp_path)
    spec = CameraSpec("A", (640, 480), (500.0, 500.0), (320.0, 240.0), 0.0, (0.0,) * 5, ROTATIONS[0], TRANSLATIONS[0])
    session = Session(tmp_path, "t", "z", 60.0, 5, 0, (View(spec, images="%d.png", path="moving.npz"), View(spec, images="%d.png")))
    moved, still = cameras_at(session, 3)
    np.testing.assert_array_equal(moved.rotation, ROTATIONS[3])
    np.testing.assert_array_equal(moved.translation_m, TRANSLATIONS[3])
    assert still == spec and moved.focal_px == spec.focal_px
    assert session.moves


@pytest.mark.parametrize(
    ("fault", "said"),
    [
        ({"rotation": 2 * ROTATIONS}, "rotation of frame 0: not a rotation"),
        ({"rotation": ROTATIONS * np.array([-1.0, 1, 1])}, "a reflection"),
        ({"rotation": ROTATIONS[:, :2]}, "shape"),
        ({"rotation": ROTATIONS[:4]}, "4 rotations and 5 translations"),
        ({"translation_m": 1000 * TRANSLATIONS}, "divide millimetres by 1000"),
        ({"translation_m": np.where(TRANSLATIONS == 7, np.nan, TRANSLATIONS)}, "translation_m of frame 2"),
        ({"rotation": ROTATIONS[:4], "translation_m": TRANSLATIONS[:4]}, "4 frames; expected 5"),
    ],
)
def test_what_cannot_be_used_is_a_sentence(tmp_path, fault, said):
    with pytest.raises(InputError, match=said):
        read_camera_path(written(tmp_path, **fault), 5)


def test_a_missing_file_and_a_missing_array_are_named(tmp_path):
    with pytest.raises(InputError, match="no such file"):
        read_camera_path(tmp_path / "gone.npz", 1)
    np.savez(tmp_path / "half.npz", rotation=ROTATIONS)
    with pytest.raises(InputError, match="no `translation_m`"):
        read_camera_path(tmp_path / "half.npz", 1)
