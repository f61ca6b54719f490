r"""Calibrations of Qualisys Track Manager: XML, usually named `*.qca.txt`.

Focal lengths and the principal point are in 1/64 pixel. The principal point is counted from the sensor's corner, and `fov_video` gives the recorded
part of the sensor (left, top, right, bottom, inclusive). `transform` holds r11 ... r33 by rows and the camera's *centre* C in millimetres. The camera
looks along its negative z, with y up: $X_{camera} = \mathrm{diag}(1, -1, -1)\, R\, (X_{world} - C)$. The world's z is up. `radialDistortion1..3` and
`tangentalDistortion1..2` (the format's spelling) are k1, k2, k3 and p1, p2, dimensionless.
"""

import math
from collections.abc import Callable
from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from bayes_body.base.errors import InputError, input_error
from bayes_body.recording.readers.calibration.calibrated import Calibrated, calibrated
from bayes_body.recording.readers.calibration.xml import Format
from bayes_body.recording.readers.faults import unnoted
from bayes_body.recording.readers.options import Axis

UP: Axis = "z"
MM = 1e-3
SUBPIXELS = 64.0
# Models that film. A hybrid camera films, and sees markers.
FILMING = ("video", "hybrid")
KIND = "a calibration of Qualisys Track Manager (*.qca.txt)"
Y_DOWN_Z_FORWARD = np.diag([1.0, -1.0, -1.0])


def read_qualisys(path: Path, note: Callable[[str], None] = unnoted) -> list[Calibrated]:
    """The video cameras of a file, in its order. Cameras that record only markers are left out.

    Args:
        path: the file.
        note: receives a sentence about the cameras that are left out.

    Raises:
        InputError: no file, not XML, or no video camera in it.
        FaultyFileError: one sentence for each fault.
    """
    return QUALISYS.read(path, note)


def _model(element: ElementTree.Element) -> str:
    return element.get("model", "?")


def _films(model: str) -> bool:
    return model.lower() in ("?", "none") or any(word in model.lower() for word in FILMING)


def _camera(entry: str, name: str, element: ElementTree.Element) -> Calibrated:
    turned = _number(entry, element, "viewrotation", 0.0)
    if turned:
        remedy = "set the view rotation to 0 in Qualisys Track Manager and export calibration and videos again"
        raise input_error(f"{entry}: viewrotation", f"{turned:g} degrees", "0, images in the sensor's orientation", remedy)
    inner, outer, recorded = (_child(entry, element, tag) for tag in ("intrinsic", "transform", "fov_video"))
    if _number(entry, inner, "skew", 0.0):
        raise input_error(f"{entry}: skew", f"{inner.get('skew')}", "0, since the unit of skew is not known", "calibrate again without skew")
    first_column, first_row, last_column, last_row = (_number(entry, recorded, key) for key in ("left", "top", "right", "bottom"))
    fx, fy, cx, cy = (_number(entry, inner, key) / SUBPIXELS for key in ("focalLengthU", "focalLengthV", "centerPointU", "centerPointV"))
    k1, k2, k3 = (_number(entry, inner, f"radialDistortion{i}", 0.0) for i in (1, 2, 3))
    p1, p2 = (_number(entry, inner, f"tangentalDistortion{i}", 0.0) for i in (1, 2))
    R = Y_DOWN_Z_FORWARD @ np.array([[_number(entry, outer, f"r{i}{j}") for j in (1, 2, 3)] for i in (1, 2, 3)])
    centre_m = MM * np.array([_number(entry, outer, axis) for axis in "xyz"])
    matrix = [[fx, 0.0, cx - first_column], [0.0, fy, cy - first_row], [0.0, 0.0, 1.0]]
    return calibrated(entry, name, (last_column - first_column + 1, last_row - first_row + 1), matrix, (k1, k2, p1, p2, k3), R, -R @ centre_m)


def _child(entry: str, element: ElementTree.Element, tag: str) -> ElementTree.Element:
    child = element.find(tag)
    if child is None:
        raise input_error(entry, f"no <{tag}>", "<transform>, <intrinsic> and <fov_video>", "export the calibration again, with the video cameras")
    return child


def _number(entry: str, element: ElementTree.Element, key: str, default: float | None = None) -> float:
    text = element.get(key)
    if text is None and default is not None:
        return default
    try:
        value = float(text or "")
    except ValueError:
        value = math.nan
    # Its squares and products must be finite too.
    if not abs(value) < 1e12:
        raise _no_number(entry, element, key, text)
    return value


def _no_number(entry: str, element: ElementTree.Element, key: str, text: str | None) -> InputError:
    problem = "missing" if text is None else f"'{text[:40]}'"
    return input_error(f"{entry}: {element.tag} {key}", problem, "a finite number", "restore the file, or export the calibration again")


QUALISYS = Format(KIND, "camera", "serial", _model, _films, _camera)
