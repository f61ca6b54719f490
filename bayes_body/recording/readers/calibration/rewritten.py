"""Write the cameras of a session as a calibration in the format from which they were imported, so that other programs can use them.

A copy of the files is changed only in what belongs to the session's cameras: rotation and translation, and the lens if it differs. OpenCV's files
keep numbers, matrices, texts and lists, but no comments.
"""

import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path
from xml.etree import ElementTree

import cv2
import numpy as np
import tomlkit
from numpy.typing import NDArray

from bayes_body.base.errors import input_error
from bayes_body.base.files.atomic import make_folder, write_text
from bayes_body.base.files.read import read_text
from bayes_body.recording.readers.calibration import opencv, qualisys, vicon
from bayes_body.recording.readers.calibration.calibrated import Calibrated
from bayes_body.recording.readers.calibration.toml import camera_name, camera_tables, read_calibration_toml
from bayes_body.recording.readers.calibration.xml import read_root
from bayes_body.recording.readers.options import METRES
from bayes_body.recording.readers.parsec_files import MM, read_calibration
from bayes_body.recording.session.session import CameraSpec

PARSEC = "Camera*.cal"
type Cameras = Mapping[str, CameraSpec]


def rewrite_calibration(source: Path, folder: Path, imported: Sequence[CameraSpec], current: Sequence[CameraSpec]) -> Path:
    """Write a copy of a calibration with other cameras. Return its path.

    Args:
        source: the file or folder from which the cameras were imported.
        folder: where the copy goes, under the same name.
        imported: the session's cameras as they were imported.
        current: the same cameras now.

    Raises:
        InputError: the calibration cannot be read, its lenses were changed on import and it is no TOML, or the copy cannot be written.
    """
    target, cameras = make_folder(folder) / source.name, {camera.name: camera for camera in current}
    changed = {new.name for old, new in zip(imported, current, strict=True) if (old.focal_px, old.centre_px) != (new.focal_px, new.centre_px)}
    if source.is_dir() and list(source.glob(PARSEC)):
        _parsec(source, target, cameras)
    elif source.is_dir():
        calibrated = opencv.read_opencv(source, 1.0)
        _check_lenses(source, calibrated, imported)
        opencv.rewrite_opencv(source, target, cameras, _unit_m(calibrated, imported))
    elif source.suffix == ".toml":
        calibrated = read_calibration_toml(source)
        _toml(source, target, cameras, changed | _with_other_lens(calibrated, imported), _unit_m(calibrated, imported))
    elif source.suffix == ".xcp":
        _check_lenses(source, vicon.read_vicon(source), imported)
        _vicon(source, target, cameras, changed)
    else:
        _check_lenses(source, qualisys.read_qualisys(source), imported)
        _qualisys(source, target, cameras, changed)
    return target


def _unit_m(calibrated: Sequence[Calibrated], imported: Sequence[CameraSpec]) -> float:
    """Return the unit of the translations of a calibration, metres: the one in which they are nearest to those of the session."""
    places = {camera.name: camera.translation_m for camera in imported}
    pairs = [(camera.translation_m, places[camera.name]) for camera in calibrated if camera.name in places]
    return min(METRES.values(), key=lambda unit_m: sum(float(np.linalg.norm(unit_m * file_t - session_t)) for file_t, session_t in pairs))


def _with_other_lens(calibrated: Sequence[Calibrated], imported: Sequence[CameraSpec]) -> set[str]:
    """Return the names of the cameras whose lens was changed on import: their pictures were turned or scaled, or the file was wrong."""
    lenses = {camera.name: _lens(camera) for camera in imported}
    return {camera.name for camera in calibrated if camera.name in lenses and not np.allclose(_lens(camera), lenses[camera.name], rtol=1e-6)}


def _lens(camera: Calibrated | CameraSpec) -> list[float]:
    return [*camera.focal_px, *camera.centre_px, *camera.distortion]


def _check_lenses(source: Path, calibrated: Sequence[Calibrated], imported: Sequence[CameraSpec]) -> None:
    if names := _with_other_lens(calibrated, imported):
        problem = f"the lens of {', '.join(sorted(names))} was changed on import (--rig)"
        raise input_error(source, problem, "the lens of the file", "use the new session, or correct the file and import it again")


def _matrix(camera: CameraSpec) -> list[list[float]]:
    (fx, fy), (cx, cy) = camera.focal_px, camera.centre_px
    return [[fx, camera.skew * fx, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]]


def _vector(camera: CameraSpec) -> list[float]:
    return cv2.Rodrigues(np.asarray(camera.rotation, float))[0].ravel().tolist()


def _toml(source: Path, target: Path, cameras: Cameras, changed: set[str], unit_m: float) -> None:
    document = tomlkit.parse(read_text(source, "a calibration"))
    for header, table in camera_tables(document):
        camera = cameras.get(camera_name(header, table.get("name")))
        if camera is None:
            continue
        # As it was: a matrix by rows, or a Rodrigues vector.
        is_matrix = np.size(table.get("rotation", ())) == 9
        table["rotation"] = np.asarray(camera.rotation, float).tolist() if is_matrix else _vector(camera)
        table["translation"] = (np.asarray(camera.translation_m, float) / unit_m).tolist()
        # The session's camera is that of the pictures, also if they were turned or scaled against the calibration.
        if "rotation_count" in table:
            table["rotation_count"] = 0
        if camera.name in changed:
            table["matrix"], table["size"], table["distortions"] = _matrix(camera), list(camera.size_px), list(camera.distortion)
    write_text(target, tomlkit.dumps(document))


def _qualisys(source: Path, target: Path, cameras: Cameras, changed: set[str]) -> None:
    root = read_root(source, qualisys.KIND)
    for element in root.iter("camera"):
        camera = cameras.get(element.get("serial", ""))
        outer, inner, recorded = (element.find(tag) for tag in ("transform", "intrinsic", "fov_video"))
        if camera is None or outer is None or inner is None or recorded is None:
            continue
        R = qualisys.Y_DOWN_Z_FORWARD @ np.asarray(camera.rotation, float)
        centre = -np.asarray(camera.rotation, float).T @ np.asarray(camera.translation_m, float) / qualisys.MM
        numbers = {f"r{row + 1}{column + 1}": R[row, column] for row in range(3) for column in range(3)}
        _set(outer, numbers | dict(zip("xyz", centre, strict=True)))
        if camera.name in changed:
            corner = [float(recorded.get(side, "0")) for side in ("left", "top")]
            _set(inner, {f"focalLength{axis}": qualisys.SUBPIXELS * focal for axis, focal in zip("UV", camera.focal_px, strict=True)})
            centre_px = zip("UV", camera.centre_px, corner, strict=True)
            _set(inner, {f"centerPoint{axis}": qualisys.SUBPIXELS * (place + start) for axis, place, start in centre_px})
    write_text(target, ElementTree.tostring(root, encoding="unicode", xml_declaration=True))


def _vicon(source: Path, target: Path, cameras: Cameras, changed: set[str]) -> None:
    from scipy.spatial.transform import Rotation

    root = read_root(source, vicon.KIND)
    for element in root.iter("Camera"):
        camera, frames = cameras.get(element.get("DEVICEID", "")), element.findall("KeyFrames/KeyFrame")
        if camera is None or not frames:
            continue
        R = np.asarray(camera.rotation, float)
        frames[-1].set("ORIENTATION", _joined(Rotation.from_matrix(R).as_quat()))
        frames[-1].set("POSITION", _joined(-R.T @ np.asarray(camera.translation_m, float) / vicon.MM))
        if camera.name in changed:
            frames[-1].set("FOCAL_LENGTH", repr(float(camera.focal_px[0])))
            frames[-1].set("PRINCIPAL_POINT", _joined(np.array(camera.centre_px)))
    write_text(target, ElementTree.tostring(root, encoding="unicode", xml_declaration=True))


def _joined(numbers: NDArray[np.float64]) -> str:
    return " ".join(repr(float(value)) for value in numbers)


def _set(element: ElementTree.Element, numbers: Mapping[str, float]) -> None:
    for key, value in numbers.items():
        element.set(key, repr(float(value)))


def _parsec(source: Path, target: Path, cameras: Cameras) -> None:
    make_folder(target)
    for path in sorted(source.glob(PARSEC)):
        camera = cameras.get(path.stem.replace("Camera", "CAM"))
        if camera is None:
            shutil.copyfile(path, target / path.name)
            continue
        # A file that cannot be read is not copied.
        read_calibration(path)
        rows: list[Sequence[float] | NDArray[np.float64]] = [camera.focal_px, camera.centre_px, [camera.skew], camera.distortion]
        rows += [*np.asarray(camera.rotation, float), np.asarray(camera.translation_m, float) / MM, _vector(camera)]
        write_text(target / path.name, "".join(f"{' '.join(repr(float(value)) for value in row)}\n" for row in rows))
