"""One rig, written in every laboratory's format, is the same cameras when read; and what cannot be a rig is refused."""

from pathlib import Path
from typing import NamedTuple

import cv2
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import simulated_rigs

from bayes_body.base.errors import FaultyFileError, InputError
from bayes_body.base.geometry.camera import Camera, project, turning_radius
from bayes_body.recording.readers.calibration.calibrated import Calibrated, calibrated, check_rig, rotation_given_twice
from bayes_body.recording.readers.calibration.opencv import read_opencv
from bayes_body.recording.readers.calibration.qualisys import read_qualisys
from bayes_body.recording.readers.calibration.toml import read_calibration_toml
from bayes_body.recording.readers.calibration.vicon import read_vicon
from bayes_body.recording.readers.parsec_files import read_calibration
from bayes_body.recording.session.session import CameraSpec

SIZE = (1280, 960)


class Lens(NamedTuple):
    """A camera as its maker knows it: matrix and distortion, rotation and centre in metres."""

    name: str
    K: np.ndarray
    distortion: np.ndarray
    R: np.ndarray
    C: np.ndarray

    @property
    def t_m(self) -> np.ndarray:
        return -self.R @ self.C


def rig() -> list[Lens]:
    """Four cameras around the z axis, all different, that look at a point above the origin."""
    lenses = []
    for i, azimuth in enumerate((0.3, 1.7, 3.4, 4.9)):
        C = np.array([4.1 * np.cos(azimuth), 3.6 * np.sin(azimuth), 1.1 + 0.4 * i])
        forward = np.array([0.1, -0.2, 0.9]) - C
        forward /= np.linalg.norm(forward)
        right = np.cross(forward, [0.05 * i, 0.0, 1.0])
        right /= np.linalg.norm(right)
        R = np.stack([right, np.cross(forward, right), forward])
        K = np.array([[1100.0 + 31 * i, 0, 640.5 + 7 * i], [0, 1085.0 - 13 * i, 477.25 - 5 * i], [0, 0, 1]])
        distortion = np.array([-0.21 + 0.03 * i, 0.11 - 0.02 * i, 0.004 - 0.001 * i, -0.003 + 0.0015 * i, -0.02 + 0.005 * i])
        lenses.append(Lens(f"cam{i + 1}", K, distortion, R, C))
    return lenses


def radial_rig() -> list[Lens]:
    """The same with lenses that Vicon's format can express: without tangential distortion."""
    return [lens._replace(distortion=lens.distortion * [1, 1, 0, 0, 1]) for lens in rig()]


def specs(lenses: list[Lens]) -> list[CameraSpec]:
    return [
        CameraSpec(
            lens.name,
            SIZE,
            tuple(np.diag(lens.K)[:2].tolist()),
            tuple(lens.K[:2, 2].tolist()),
            0.0,
            tuple(lens.distortion.tolist()),
            lens.R,
            lens.t_m,
        )
        for lens in lenses
    ]


def write_opencv(folder: Path, lenses: list[Lens], suffix: str, vector: bool) -> Path:
    folder.mkdir()
    for lens in lenses:
        file = cv2.FileStorage(str(folder / f"{lens.name}{suffix}"), cv2.FILE_STORAGE_WRITE)
        file.write("image_width", SIZE[0])
        file.write("image_height", SIZE[1])
        file.write("camera_matrix", lens.K)
        file.write("distortion_coefficients", lens.distortion[None])
        file.write("rvec" if vector else "R", cv2.Rodrigues(lens.R)[0] if vector else lens.R)
        file.write("T", 1000 * lens.t_m)
        file.release()
    return folder


def write_easymocap(folder: Path, lenses: list[Lens]) -> Path:
    folder.mkdir()
    inner, outer = (cv2.FileStorage(str(folder / name), cv2.FILE_STORAGE_WRITE) for name in ("intri.yml", "extri.yml"))
    for file in (inner, outer):
        file.startWriteStruct("names", cv2.FileNode_SEQ)
        for lens in lenses:
            file.write("", lens.name)
        file.endWriteStruct()
    for lens in lenses:
        inner.write(f"K_{lens.name}", lens.K)
        inner.write(f"dist_{lens.name}", lens.distortion[None])
        outer.write(f"R_{lens.name}", cv2.Rodrigues(lens.R)[0])
        outer.write(f"Rot_{lens.name}", lens.R)
        outer.write(f"T_{lens.name}", lens.t_m)
    inner.release()
    outer.release()
    return folder


def write_toml(path: Path, lenses: list[Lens]) -> Path:
    tables = [
        f'[key_{i}]\nname = "{lens.name}"\nsize = [{SIZE[0]}.0, {SIZE[1]}.0]\nmatrix = {lens.K.tolist()}\ndistortions = {lens.distortion.tolist()}\n'
        f"rotation = {cv2.Rodrigues(lens.R)[0].ravel().tolist()}\ntranslation = {lens.t_m.tolist()}\nfisheye = false\n"
        for i, lens in enumerate(lenses)
    ]
    path.write_text("\n".join([*tables, "[metadata]\nadjusted = false\nerror = 0.5\n"]))
    return path


def write_qualisys(path: Path, lenses: list[Lens], left: int = 0) -> Path:
    """The region that is recorded begins at column `left` of a larger sensor."""
    cameras = []
    for lens in lenses:
        rotation = np.diag([1, -1, -1]) @ lens.R
        turn = " ".join(f'r{i + 1}{j + 1}="{rotation[i, j]!r}"' for i in range(3) for j in range(3)).replace("np.float64(", "").replace(")", "")
        place = " ".join(f'{axis}="{1000 * value:.10f}"' for axis, value in zip("xyz", lens.C, strict=True))
        k1, k2, p1, p2, k3 = lens.distortion
        inner = (
            f'focalLengthU="{64 * lens.K[0, 0]}" focalLengthV="{64 * lens.K[1, 1]}" centerPointU="{64 * (lens.K[0, 2] + left)}" '
            f'centerPointV="{64 * lens.K[1, 2]}" skew="0" radialDistortion1="{k1}" radialDistortion2="{k2}" radialDistortion3="{k3}" '
            f'tangentalDistortion1="{p1}" tangentalDistortion2="{p2}"'
        )
        cameras.append(
            f'<camera active="1" serial="{lens.name}" model="Miqus Video" viewrotation="0">'
            f'<fov_video left="{left}" top="0" right="{left + SIZE[0] - 1}" bottom="{SIZE[1] - 1}"/>'
            f"<transform {turn} {place}/><intrinsic {inner}/></camera>"
        )
    markers = '<camera serial="9" model="Oqus 7"><transform/></camera>'
    path.write_text(f"<?xml version='1.0' encoding='ASCII'?><calibration><cameras>{''.join(cameras)}{markers}</cameras></calibration>")
    return path


def write_parsec(folder: Path, lenses: list[Lens]) -> list[Path]:
    folder.mkdir()
    paths = []
    for lens in lenses:
        focal, centre = (lens.K[0, 0], lens.K[1, 1]), lens.K[:2, 2]
        numbers = [*focal, *centre, 0.0, *lens.distortion, *lens.R.ravel(), *(1000 * lens.t_m), *cv2.Rodrigues(lens.R)[0].ravel()]
        paths.append(folder / f"{lens.name}.cal")
        paths[-1].write_text("\n".join(f"{number:.12g}" for number in numbers))
    return paths


FORMATS = {
    "OpenCV yml, matrix": lambda folder: read_opencv(write_opencv(folder / "a", rig(), ".yml", False), 1e-3),
    "OpenCV yml, Rodrigues vector": lambda folder: read_opencv(write_opencv(folder / "a", rig(), ".yml", True), 1e-3),
    "OpenCV xml": lambda folder: read_opencv(write_opencv(folder / "a", rig(), ".xml", False), 1e-3),
    "OpenCV json": lambda folder: read_opencv(write_opencv(folder / "a", rig(), ".json", False), 1e-3),
    "EasyMocap": lambda folder: read_opencv(write_easymocap(folder / "a", rig()), 1.0),
    "Pose2Sim": lambda folder: read_calibration_toml(write_toml(folder / "Calib.toml", rig())),
    "Caliscope": lambda folder: read_calibration_toml(simulated_rigs.write_toml(folder / "array.toml", specs(rig()), nested=True)),
    "Vicon": lambda folder: read_vicon(simulated_rigs.write_vicon(folder / "a.xcp", specs(radial_rig()))),
    "Qualisys": lambda folder: read_qualisys(write_qualisys(folder / "a.qca.txt", rig())),
    "Qualisys, part of the sensor": lambda folder: read_qualisys(write_qualisys(folder / "a.qca.txt", rig(), left=320)),
    "PARSEC": lambda folder: [read_calibration(path) for path in write_parsec(folder / "CALIB", rig())],
}


@pytest.fixture
def points() -> np.ndarray:
    """1000 points of a room before all four cameras, metres."""
    return np.random.default_rng(5).uniform([-0.8, -0.8, 0.0], [0.8, 0.8, 1.9], (1000, 3))


@pytest.mark.parametrize("kind", FORMATS)
def test_every_format_is_the_same_rig(kind, tmp_path, points):
    cameras = FORMATS[kind](tmp_path)
    check_rig(kind, cameras)
    lenses = radial_rig() if kind == "Vicon" else rig()
    assert [camera.name for camera in cameras] == [lens.name for lens in lenses]
    for camera, lens in zip(cameras, lenses, strict=True):
        assert camera.size_px == (None if kind in ("PARSEC", "EasyMocap") else SIZE)
        np.testing.assert_allclose(camera.viewpoint_m, lens.C, atol=1e-8)
        expected = cv2.projectPoints(points, cv2.Rodrigues(lens.R)[0], lens.t_m, lens.K, lens.distortion)[0][:, 0]
        K = np.array([[camera.focal_px[0], 0, camera.centre_px[0]], [0, camera.focal_px[1], camera.centre_px[1]], [0, 0, 1]])
        vector = cv2.Rodrigues(camera.rotation)[0]
        read = cv2.projectPoints(points, vector, camera.translation_m, K, np.array(camera.distortion))[0][:, 0]
        np.testing.assert_allclose(read, expected, atol=1e-3)
        seen, visible = ours(camera, points)
        assert visible.mean() > 0.9
        np.testing.assert_allclose(seen[visible], expected[visible], atol=1e-3)


def ours(camera: Calibrated, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Through the package's own camera, in double precision."""
    spec = camera.spec(SIZE)
    with jax.enable_x64(True):
        lens = np.array(spec.distortion)
        leaves = (spec.rotation, spec.translation_m, spec.focal_px, spec.centre_px, spec.skew, lens, turning_radius(lens), spec.size_px)
        pixels, visible = project(Camera(*(jnp.asarray(leaf, float) for leaf in leaves)), jnp.asarray(points))
    return np.asarray(pixels), np.asarray(visible)


def test_skew_is_the_matrix_of_the_camera(points):
    lens = rig()[0]
    K = lens.K.copy()
    K[0, 1] = 3.0
    camera = calibrated("here", "a", SIZE, K, lens.distortion, lens.R, lens.t_m)
    plain, _ = ours(camera._replace(skew=0.0), points)
    skewed, _ = ours(camera, points)
    np.testing.assert_allclose(skewed[:, 0] - plain[:, 0], 3.0 * (plain[:, 1] - K[1, 2]) / K[1, 1], atol=1e-6)


def one(**changes) -> Calibrated:
    lens = rig()[0]
    values = {"size": SIZE, "matrix": lens.K, "distortion": lens.distortion, "rotation": lens.R, "translation_m": lens.t_m} | changes
    return calibrated("file: camera 'a'", values.pop("name", "a"), **values)


@pytest.mark.parametrize("count", [0, 4, 5, 8, 12, 14])
def test_distortion_of_any_length_whose_end_is_zero(count):
    numbers = np.zeros(count)
    numbers[:4] = [0.1, 0.2, 0.3, 0.4][:count]
    assert one(distortion=numbers).distortion == tuple(np.append(numbers, np.zeros(5))[:5])


REFUSED = {
    "rational lens": (
        {"distortion": [0.1, 0, 0, 0, 0, 0.2, 0, 0]},
        "distortion: 8 numbers, .*rational.*; expected at most k1, k2, p1, p2, k3; calibrate",
    ),
    "three coefficients": ({"distortion": [0.1, 0, 0]}, "distortion: 3 numbers .*; expected 4 or 5"),
    "no focal length": ({"matrix": np.diag([0, 1000, 1.0])}, "focal length x = 0; expected a positive number"),
    "NaN": ({"matrix": np.diag([np.nan, 1000, 1.0])}, "camera matrix: .*; expected 3 x 3 finite numbers"),
    "transposed matrix": ({"matrix": rig()[0].K.T}, "camera matrix: .*; expected fx, skew, cx; 0, fy, cy; 0, 0, 1"),
    "reflection": ({"rotation": np.diag([1.0, 1, -1])}, "rotation: a reflection, .*; expected a rotation, .*; flip the sign"),
    "no rotation": ({"rotation": np.full((3, 3), 0.5)}, "rotation: not a rotation, .*; copy R again"),
    "four numbers": ({"rotation": np.zeros(4)}, "rotation: 4 numbers .*; expected 9 finite numbers by rows, or 3"),
    "infinitely far": ({"translation_m": [0, np.inf, 0]}, "translation: 3 numbers .*; expected three finite numbers"),
    "half a pixel": ({"size": (640.5, 480)}, "image size: .*; expected width and height, whole numbers"),
    "folds at once": ({"distortion": [-300.0, 0, 0, 0]}, "distortion: k1, k2, k3 = -300, 0, 0: the lens folds the picture .* pixels from"),
    "sees nothing": ({"matrix": np.diag([1.0, 1000, 1.0])}, "focal length: x = 1: the camera sees nothing; expected .* pixels for an image of"),
    "no name": ({"name": " "}, "without a name"),
}


@pytest.mark.parametrize("fault", REFUSED)
def test_what_is_no_camera(fault):
    changes, sentence = REFUSED[fault]
    with pytest.raises(FaultyFileError, match=f"^file: camera 'a'.*{sentence}") as error:
        one(**changes)
    assert len(error.value.sentences) == 1


def test_all_faults_of_a_camera_are_said_at_once():
    with pytest.raises(FaultyFileError) as error:
        one(distortion=[1.0], rotation=np.eye(3) * 2, size=(0, 3))
    assert len(error.value.sentences) == 3


def test_rotation_given_twice():
    R = rig()[0].R
    np.testing.assert_array_equal(rotation_given_twice("a", R, cv2.Rodrigues(R)[0]), R)
    with pytest.raises(InputError, match=r"the Rodrigues vector contradicts the rotation matrix by 0.2"):
        rotation_given_twice("a", R, cv2.Rodrigues(R)[0] + 0.1)


def test_a_room_of_millimetres_and_one_read_twice_as_small():
    cameras = cameras_of_the_rig()
    check_rig("room", cameras)
    check_rig("room", cameras[:1])
    with pytest.raises(
        InputError, match=r"room: cameras .* m apart .*; expected a room of 0.05 to 100 m; .*factor of 1000, millimetres read as metres"
    ):
        check_rig("room", [camera._replace(translation_m=1000 * camera.translation_m) for camera in cameras])
    with pytest.raises(InputError, match="factor of 1000, millimetres read as metres"):
        check_rig("room", [cameras[0]._replace(translation_m=1000 * cameras[0].translation_m)])
    with pytest.raises(InputError, match=r"all cameras within 0.00.* factor of 1000, metres read as millimetres"):
        check_rig("room", [camera._replace(translation_m=camera.translation_m / 1000) for camera in cameras])


def test_a_name_given_twice():
    cameras = cameras_of_the_rig()
    with pytest.raises(InputError, match="room: camera 'cam1': 2 cameras have this name"):
        check_rig("room", [*cameras, cameras[0]])


def cameras_of_the_rig() -> list[Calibrated]:
    return [calibrated("here", lens.name, SIZE, lens.K, lens.distortion, lens.R, lens.t_m) for lens in rig()]
