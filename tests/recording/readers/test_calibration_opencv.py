"""OpenCV's files: the names that people use, and what is refused."""

import numpy as np
import pytest

from bayes_body.base.errors import InputError
from bayes_body.recording.readers.calibration.opencv import read_opencv


def matrix(key: str, values: np.ndarray) -> str:
    rows, columns = values.shape
    return f"{key}: !!opencv-matrix\n   rows: {rows}\n   cols: {columns}\n   dt: d\n   data: {values.ravel().tolist()}\n"


PARTS = {
    "size": "image_width: 640\nimage_height: 480\n",
    "matrix": matrix("camera_matrix", np.array([[600.0, 0, 320], [0, 610, 240], [0, 0, 1]])),
    "distortion": matrix("dist", np.array([[-0.1, 0.02, 0.001, -0.001, 0.0]])),
    "rotation": matrix("R", np.eye(3)[[1, 2, 0]]),
    "translation": matrix("T", np.array([[10.0], [20.0], [300.0]])),
}


@pytest.fixture
def write(tmp_path):
    """`write(size="")`: a sound file with some of its parts replaced."""

    def call(name="left.yml", **changes):
        path = tmp_path / name
        path.write_text("%YAML:1.0\n---\n" + "".join((PARTS | changes).values()))
        return path

    return call


def test_one_file(write):
    (camera,) = read_opencv(write(), 1e-2)
    assert (camera.name, camera.size_px) == ("left", (640, 480))
    np.testing.assert_allclose(camera.translation_m, [0.1, 0.2, 3.0])


SAME = {
    "list for the size": {"size": "image_size: [640, 480]\n"},
    "K": {"matrix": PARTS["matrix"].replace("camera_matrix", "K")},
    "M1 and D1": {"matrix": PARTS["matrix"].replace("camera_matrix", "M1"), "distortion": PARTS["distortion"].replace("dist", "D1")},
    "matrix as lists": {"matrix": "K: [[600, 0, 320], [0, 610, 240], [0, 0, 1]]\n"},
    "tvec": {"translation": "tvec: [10., 20., 300.]\n"},
    "rational with zeros": {"distortion": matrix("dist", np.array([[-0.1, 0.02, 0.001, -0.001, 0, 0, 0, 0]]))},
}


@pytest.mark.parametrize("way", SAME)
def test_other_words_for_the_same(write, way):
    (plain,) = read_opencv(write(), 1.0)
    (camera,) = read_opencv(write(**SAME[way]), 1.0)
    assert camera.spec((640, 480)) == plain.spec((640, 480))
    assert camera.size_px == plain.size_px


def test_a_file_without_a_size(write):
    assert read_opencv(write(size=""), 1.0)[0].size_px is None


REFUSED = {
    "no matrix": ({"matrix": ""}, "no camera matrix; expected one under a name such as camera_matrix"),
    "no distortion": ({"distortion": ""}, "no distortion coefficients"),
    "intrinsics alone": ({"rotation": "", "translation": ""}, "intrinsics without extrinsics do not place a camera"),
    "no rotation": ({"rotation": ""}, "no rotation from the world to the camera"),
    "rational": ({"distortion": matrix("dist", np.full((1, 8), 0.1))}, "rational"),
    "stereo pair": ({"size": matrix("M2", np.eye(3))}, "the intrinsics of a stereo pair"),
    "rows without data": (
        {"translation": "T: !!opencv-matrix\n   rows: 30000\n   cols: 30000\n   dt: d\n   data: [1.]\n"},
        "1 numbers for 30000 rows",
    ),
    "text": ({"translation": "T: far\n"}, "T: no numbers"),
    "half a size": ({"size": "image_width: 640\n"}, "image size: .*; expected width and height"),
    "twice and different": ({"size": matrix("rvec", np.ones((3, 1)))}, "the Rodrigues vector contradicts"),
    "no YAML": ({"size": "a: ["}, "cannot be read by OpenCV"),
}


@pytest.mark.parametrize("fault", REFUSED)
def test_refused(write, fault, capfd):
    changes, sentence = REFUSED[fault]
    path = write(**changes)
    with pytest.raises(InputError, match=f"^{path}.*{sentence}") as error:
        read_opencv(path, 1.0)
    assert len(str(error.value).splitlines()) == 1
    assert "ERROR" not in capfd.readouterr().err


def test_nothing_to_read(tmp_path):
    with pytest.raises(InputError, match="no yml, yaml, xml or json file in it"):
        read_opencv(tmp_path, 1.0)
    (tmp_path / "a.yml").write_text("")
    with pytest.raises(InputError, match=r"a.yml: cannot be read by OpenCV"):
        read_opencv(tmp_path, 1.0)
    with pytest.raises(InputError, match=r"b.yml: no such file"):
        read_opencv(tmp_path / "b.yml", 1.0)


def test_faults_of_all_files_at_once(write, tmp_path):
    write("a.yml", matrix="")
    write("b.yml", translation="")
    with pytest.raises(InputError) as error:
        read_opencv(tmp_path, 1.0)
    assert len(str(error.value).splitlines()) == 2
