"""Calibrations of Vicon Nexus: XML, named `*.xcp`.

A camera's last `KeyFrame` has its `FOCAL_LENGTH` and `PRINCIPAL_POINT` in pixels, its `ORIENTATION`, the unit quaternion (x, y, z, w) from the world
to the camera, and its `POSITION`, the camera's centre in millimetres. `PIXEL_ASPECT_RATIO` is the focal length along x over that along y. The world's
z is up. The last three numbers of `VICON_RADIAL2` are k1, k2 and k3 of the radial distortion. Other programs (OpenCap, Pose2Sim) read them as
OpenCV's; no public description says whether Vicon's polynomial leads to the distorted point, as OpenCV's does, or from it.
"""

import math
from collections.abc import Callable
from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from bayes_body.base.errors import input_error
from bayes_body.recording.readers.calibration.calibrated import Calibrated, calibrated
from bayes_body.recording.readers.calibration.xml import Format
from bayes_body.recording.readers.faults import unnoted
from bayes_body.recording.readers.options import Axis

UP: Axis = "z"
MM = 1e-3
KIND = "a calibration of Vicon (*.xcp)"
# Systems and types of cameras that film.
FILMING = ("dv", "vue", "video", "bonita")
# How far from 1 the length of a quaternion may be.
TOLERANCE = 1e-3


def read_vicon(path: Path, note: Callable[[str], None] = unnoted) -> list[Calibrated]:
    """The video cameras of a file, in its order.

    Args:
        path: the file.
        note: receives a sentence about the cameras that record only markers.

    Raises:
        InputError: no file, not XML, or no video camera in it.
        FaultyFileError: one sentence for each fault.
    """
    return VICON.read(path, note)


def _model(element: ElementTree.Element) -> str:
    return " ".join(dict.fromkeys(text for key in ("SYSTEM", "TYPE", "DISPLAY_TYPE") if (text := element.get(key)))) or "?"


def _films(model: str) -> bool:
    return any(word in model.lower() for word in FILMING)


def _camera(entry: str, name: str, element: ElementTree.Element) -> Calibrated:
    frames = element.findall("KeyFrames/KeyFrame")
    if not frames:
        raise input_error(entry, "no <KeyFrame>", "a calibrated camera", "calibrate the camera, and export the calibration again")
    frame = frames[-1]
    (fx,), (cx, cy) = (_numbers(entry, frame, key, count) for key, count in (("FOCAL_LENGTH", 1), ("PRINCIPAL_POINT", 2)))
    (aspect,) = _numbers(entry, element, "PIXEL_ASPECT_RATIO", 1) if element.get("PIXEL_ASPECT_RATIO") else [1.0]
    if not aspect > 0:
        raise input_error(f"{entry}: PIXEL_ASPECT_RATIO", f"{aspect:g}", "above 0", "export the calibration again")
    size = _numbers(entry, element, "SENSOR_SIZE", 2)
    R = _rotation(entry, _numbers(entry, frame, "ORIENTATION", 4))
    centre_m = MM * np.array(_numbers(entry, frame, "POSITION", 3))
    k1, k2, k3 = _radial(entry, frame)
    matrix = [[fx, 0.0, cx], [0.0, fx / aspect, cy], [0.0, 0.0, 1.0]]
    return calibrated(entry, name, size, matrix, (k1, k2, 0.0, 0.0, k3), R, -R @ centre_m)


def _rotation(entry: str, quaternion: list[float]) -> np.ndarray:
    from scipy.spatial.transform import Rotation

    if abs(math.hypot(*quaternion) - 1) > TOLERANCE:
        raise input_error(f"{entry}: ORIENTATION", f"a quaternion of length {math.hypot(*quaternion):.3g}", "1", "export the calibration again")
    return Rotation.from_quat(quaternion).as_matrix()


def _radial(entry: str, frame: ElementTree.Element) -> tuple[float, float, float]:
    text = frame.get("VICON_RADIAL2", "").split()[1:]
    if not text:
        return 0.0, 0.0, 0.0
    k1, k2, k3 = _floats(f"{entry}: VICON_RADIAL2", text[-3:], 3)
    return k1, k2, k3


def _numbers(entry: str, element: ElementTree.Element, key: str, count: int) -> list[float]:
    return _floats(f"{entry}: {key}", element.get(key, "").split(), count)


def _floats(subject: str, texts: list[str], count: int) -> list[float]:
    try:
        values = [float(text) for text in texts]
    except ValueError:
        values = []
    # Their squares and products must be finite too.
    if len(values) != count or not all(abs(value) < 1e12 for value in values):
        shown = " ".join(texts)[:40]
        raise input_error(subject, f"'{shown}'" if shown else "missing", f"{count} finite number{'s' * (count > 1)}", "export the calibration again")
    return values


VICON = Format(KIND, "Camera", "DEVICEID", _model, _films, _camera)
