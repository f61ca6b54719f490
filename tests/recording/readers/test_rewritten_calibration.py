"""Calibrations written anew with other cameras: EasyMocap's pair, PARSEC's text files, Caliscope's tables, and Vicon's xcp."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from simulated_rigs import rig, write_qualisys, write_toml

from bayes_body.base.errors import InputError
from bayes_body.recording.readers.agreement.changes import turned
from bayes_body.recording.readers.calibration.opencv import read_opencv
from bayes_body.recording.readers.calibration.rewritten import rewrite_calibration
from bayes_body.recording.readers.calibration.toml import read_calibration_toml
from bayes_body.recording.readers.calibration.vicon import read_vicon
from bayes_body.recording.readers.parsec_files import read_calibration
from bayes_body.recording.session.session import CameraSpec

K = np.array([[900.0, 0, 480], [0, 920, 320], [0, 0, 1]])


def camera(name, turn, place_m):
    R = cv2.Rodrigues(np.array(turn))[0]
    return CameraSpec(name, (960, 640), (900.0, 920.0), (480.0, 320.0), 0.0, (0.1, 0.0, 0.0, 0.0, 0.0), R, np.array(place_m))


BEFORE = [camera("CAM1", (0.3, 1.2, -0.4), (0.1, 0.2, 4.0)), camera("CAM2", (0.1, -0.9, 0.2), (-0.3, 0.1, 3.5))]
NEW = [camera("CAM1", (0.31, 1.22, -0.39), (0.12, 0.19, 4.03)), camera("CAM2", (0.1, -0.91, 0.21), (-0.31, 0.12, 3.52))]


def close(read, cameras):
    for got, wanted in zip(read, cameras, strict=True):
        np.testing.assert_allclose(got.rotation, wanted.rotation, atol=1e-9)
        np.testing.assert_allclose(got.translation_m, wanted.translation_m, atol=1e-9)
        np.testing.assert_allclose([*got.focal_px, *got.centre_px, *got.distortion], [*wanted.focal_px, *wanted.centre_px, *wanted.distortion])


def test_easymocaps_pair(tmp_path):
    source = tmp_path / "lab"
    source.mkdir()
    inner, outer = (cv2.FileStorage(str(source / name), cv2.FILE_STORAGE_WRITE) for name in ("intri.yml", "extri.yml"))
    for file in (inner, outer):
        file.startWriteStruct("names", cv2.FILE_NODE_SEQ)
        for spec in BEFORE:
            file.write("", spec.name)
        file.endWriteStruct()
    inner.write("rms", 0.25)
    for spec in BEFORE:
        inner.write(f"K_{spec.name}", K)
        inner.write(f"dist_{spec.name}", np.array([spec.distortion]))
        outer.write(f"R_{spec.name}", cv2.Rodrigues(spec.rotation)[0])
        outer.write(f"Rot_{spec.name}", spec.rotation)
        outer.write(f"T_{spec.name}", 100 * spec.translation_m[:, None])
    inner.release()
    outer.release()
    close(read_opencv(source, 0.01), BEFORE)
    path = rewrite_calibration(source, tmp_path / "new", BEFORE, NEW)
    written = read_opencv(path, 0.01)
    assert [read.name for read in written] == ["CAM1", "CAM2"]
    close(written, NEW)
    assert "rms: " in (path / "intri.yml").read_text()


def test_parsecs_text_files(tmp_path):
    source = tmp_path / "CALIB"
    source.mkdir()
    for spec, number in zip(BEFORE, (1, 2), strict=True):
        rows = [
            spec.focal_px,
            spec.centre_px,
            [0.0],
            spec.distortion,
            spec.rotation.ravel(),
            1000 * spec.translation_m,
            cv2.Rodrigues(spec.rotation)[0],
        ]
        (source / f"Camera{number}.cal").write_text("\n".join(" ".join(map(repr, np.ravel(row).tolist())) for row in rows))
    # The session has only one of the cameras.
    path = rewrite_calibration(source, tmp_path / "new", BEFORE[:1], NEW[:1])
    close([read_calibration(path / f"Camera{number}.cal") for number in (1, 2)], [NEW[0], BEFORE[1]])


def test_caliscopes_tables(tmp_path):
    source = tmp_path / "camera_array.toml"
    tables = [
        f"[cameras.{number}]\nrotation_count = 0\nsize = [960, 640]\nmatrix = {K.tolist()}\ndistortions = {list(spec.distortion)}\n"
        f"rotation = {spec.rotation.tolist()}\ntranslation = {spec.translation_m.tolist()}\n"
        for number, spec in enumerate(BEFORE)
    ]
    source.write_text("\n".join(tables))
    before, new = ([replace(spec, name=f"cam_{number}") for number, spec in enumerate(cameras)] for cameras in (BEFORE, NEW))
    path = rewrite_calibration(source, tmp_path / "new", before, new)
    close(read_calibration_toml(path), new)
    assert path.read_text().count("rotation_count = 0") == 2


def test_vicons_xcp(tmp_path):
    source = tmp_path / "walk.xcp"

    def key_frame(spec):
        quaternion, centre_mm = Rotation.from_matrix(spec.rotation).as_quat(), -1000 * spec.rotation.T @ spec.translation_m
        words = {
            "ORIENTATION": quaternion,
            "POSITION": centre_mm,
            "PRINCIPAL_POINT": spec.centre_px,
            "VICON_RADIAL2": (0, 0, *spec.distortion[:2], 0),
        }
        texts = {key: " ".join(map(repr, map(float, values))) for key, values in words.items()}
        texts["VICON_RADIAL2"] = f"ViconRadial2 {texts['VICON_RADIAL2']}"
        return f'<KeyFrame FOCAL_LENGTH="{spec.focal_px[0]}" {" ".join(f'{key}="{text}"' for key, text in texts.items())}/>'

    attributes = f'SYSTEM="DV" SENSOR_SIZE="960 640" PIXEL_ASPECT_RATIO="{900 / 920!r}"'
    listed = [f'<Camera DEVICEID="{spec.name}" {attributes}><KeyFrames>{key_frame(spec)}</KeyFrames></Camera>' for spec in BEFORE]
    source.write_text(f"<Cameras>{''.join(listed)}</Cameras>")
    close(read_vicon(source), BEFORE)
    close(read_vicon(rewrite_calibration(source, tmp_path / "new", BEFORE, NEW)), NEW)


def test_lenses_that_were_changed_on_import(tmp_path):
    cameras = rig(2)
    shown = [turned(camera, 1) for camera in cameras]
    source = write_toml(tmp_path / "array.toml", cameras, "rotation_count = 1", nested=True)
    path = rewrite_calibration(source, tmp_path / "new", shown, shown)
    written = read_calibration_toml(path)
    close(written, shown)
    # It is that of the turned pictures, and is not turned again.
    assert [(camera.size_px, camera.quarter_turns) for camera in written] == [((720, 1280), 0)] * 2
    with pytest.raises(InputError, match=r"room.qca.txt: the lens of c0, c1 was changed on import"):
        rewrite_calibration(write_qualisys(tmp_path / "room.qca.txt", cameras), tmp_path / "new", shown, shown)
