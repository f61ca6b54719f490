r"""A rig: the cameras of a room, without a recording. It is read from its own TOML file, a session or a Pose2Sim calibration.

The world's z points up. A camera at c that looks at a has the forward axis $f = (a - c) / |a - c|$, the right axis $r = f \times z / |f \times z|$
and the downward axis $d = f \times r$; `X_camera = R (X_world - c)` with the rows r, d, f of R. Positive roll turns the camera clockwise about f, as
seen from behind it. A moving camera follows clamped cubic splines through its keyframes: it starts and ends at rest.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

from bayes_body.base.errors import InputError, input_error, nearest
from bayes_body.base.toml.read import read_toml, validate
from bayes_body.recording.readers.calibration.calibrated import Calibrated, check_rig
from bayes_body.recording.readers.calibration.toml import read_calibration_toml
from bayes_body.recording.readers.rig_schema import KeyframeTable, RigCameraTable, RigFile, file_name
from bayes_body.recording.session.read import FILE_NAME, parse_session
from bayes_body.recording.session.session import CameraSpec

# For calibrations, which do not state a frame rate.
USUAL_FPS = 60.0
# For each up axis: the axes that play the part of x, y, z in a world whose z points up. This is a rotation, not a reflection.
TURNED = {"x": (1, 2, 0), "y": (2, 0, 1), "z": (0, 1, 2)}
# Assumed distance along the optical axis (metres) for cameras without a target. It pulls weakly, so that a single camera has a solution too.
USUAL_DISTANCE_M, PULL = 4.0, 1e-3


@dataclass(frozen=True, eq=False)
class CameraPath:
    """The keyframes of a moving camera.

    Attributes:
        times_s: (keyframe,), ascending.
        positions_m: (keyframe, 3).
        look_at_m: (keyframe, 3).
        roll: (keyframe,), radians.
    """

    times_s: Float[np.ndarray, " keyframe"]
    positions_m: Float[np.ndarray, "keyframe 3"]
    look_at_m: Float[np.ndarray, "keyframe 3"]
    roll: Float[np.ndarray, " keyframe"]

    def extrinsics(self, times_s: Float[np.ndarray, " frame"]) -> tuple[Float[np.ndarray, "frame 3 3"], Float[np.ndarray, "frame 3"]]:
        """Rotations and translations (metres) at these times. The camera stands still before the first keyframe and after the last."""
        times = np.clip(times_s, self.times_s[0], self.times_s[-1])
        position, look_at, roll = (
            CubicSpline(self.times_s, knots, bc_type="clamped")(times) for knots in (self.positions_m, self.look_at_m, self.roll)
        )
        pairs = [_extrinsics(*pose) for pose in zip(position, look_at, roll, strict=True)]
        return np.stack([rotation for rotation, _ in pairs]), np.stack([translation for _, translation in pairs])


@dataclass(frozen=True, eq=False)
class Rig:
    """Cameras; for each, whether it is grey, and its path if it moves.

    Attributes:
        name: the file's name.
        title: one line for the reader.
        fps: frames per second.
        cameras: moving cameras as they are at time 0.
        grey: for each camera, whether it has no colour.
        path: for each camera, how it moves; None if it stands still.
        aim_m: (3,), the point that the cameras look at.
    """

    name: str
    title: str
    fps: float
    cameras: tuple[CameraSpec, ...]
    grey: tuple[bool, ...]
    path: tuple[CameraPath | None, ...]
    aim_m: Float[np.ndarray, "3"]

    def select(self, names: Sequence[str]) -> "Rig":
        """The rig with these cameras only, in the rig's order. The aim stays the same.

        Raises:
            InputError: no such camera.
        """
        names_of_rig = [camera.name for camera in self.cameras]
        for name in names:
            if name not in names_of_rig:
                raise InputError(f"rig {self.name}: camera '{name}': no such camera; {nearest(name, names_of_rig)}")
        selected = [c for c, name in enumerate(names_of_rig) if name in names]
        cameras, grey, path = (tuple(column[c] for c in selected) for column in (self.cameras, self.grey, self.path))
        return replace(self, cameras=cameras, grey=grey, path=path)

    def posed(self, frames: int) -> list[list[CameraSpec]]:
        """Each camera as it is in each of the first frames."""
        return [self._posed(c, frames) for c in range(len(self.cameras))]

    def _posed(self, c: int, frames: int) -> list[CameraSpec]:
        path, camera = self.path[c], self.cameras[c]
        if path is None:
            return [camera] * frames
        rotations, translations = path.extrinsics(np.arange(frames) / self.fps)
        return [replace(camera, rotation=R, translation_m=t) for R, t in zip(rotations, translations, strict=True)]


def read_rig(path: Path, fps: float | None = None) -> Rig:
    """The rig of a file: a rig's TOML, a session (the folder or its `session.toml`), or a calibration in Pose2Sim's format.

    Args:
        path: the file.
        fps: frames per second; overrides the file's rate. A Pose2Sim calibration states none and gets 60; it is in metres, with z up.

    Raises:
        InputError: no such file, or not TOML.
        FaultyFileError: one sentence for each fault in it.
    """
    path = path / FILE_NAME if path.is_dir() else path
    tables = read_toml(path)
    if "camera" not in tables and any(isinstance(table, Mapping) and "matrix" in table for table in tables.values()):
        rig = _of_calibration(path)
    elif "frames" in tables and "camera" in tables:
        rig = _of_session(path, tables)
    else:
        rig = _of_rig(path, validate(RigFile, tables, str(path)))
    _check_names(path, rig)
    return rig if fps is None else replace(rig, fps=fps)


def _of_rig(path: Path, table: RigFile) -> Rig:
    cameras = tuple(_camera(camera) for camera in table.cameras)
    aims = [point for camera in table.cameras for point in _look_at(camera)]
    aim = np.mean(aims, axis=0) if aims else _crossing(cameras)
    paths = tuple(_path(camera.path) if camera.path else None for camera in table.cameras)
    return Rig(path.stem, table.title, table.fps, cameras, tuple(camera.grey for camera in table.cameras), paths, aim)


def _look_at(table: RigCameraTable) -> list[NDArray[np.float64]]:
    if table.path:
        return [np.mean([keyframe.look_at_m for keyframe in table.path], axis=0)]
    return [] if table.look_at_m is None else [np.array(table.look_at_m)]


def _camera(table: RigCameraTable) -> CameraSpec:
    size = table.size_px
    centre = ((size[0] - 1) / 2, (size[1] - 1) / 2) if table.centre_px is None else table.centre_px
    return CameraSpec(table.name, size, table.focal_px, centre, table.skew, table.distortion, *_place(table))


def _place(table: RigCameraTable) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """The extrinsics at time 0."""
    if table.path:
        rotations, translations = _path(table.path).extrinsics(np.zeros(1))
        return rotations[0], translations[0]
    if table.rotation is not None:
        return np.array(table.rotation), np.array(table.translation_m)
    return _extrinsics(np.array(table.position_m), np.array(table.look_at_m), float(np.radians(table.roll_deg)))


def _path(keyframes: Sequence[KeyframeTable]) -> CameraPath:
    times, positions, aims, roll = (
        np.array([getattr(keyframe, key) for keyframe in keyframes], float) for key in ("time_s", "position_m", "look_at_m", "roll_deg")
    )
    return CameraPath(times, positions, aims, np.radians(roll))


def _extrinsics(position: NDArray[np.float64], look_at: NDArray[np.float64], roll: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """(3, 3) and (3,), metres."""
    forward = (look_at - position) / np.linalg.norm(look_at - position)
    right = np.cross(forward, (0.0, 0.0, 1.0))
    right /= np.linalg.norm(right)
    down = np.cross(forward, right)
    cosine, sine = np.cos(roll), np.sin(roll)
    rotation = np.stack([cosine * right + sine * down, cosine * down - sine * right, forward])
    return rotation, -rotation @ position


def _of_session(path: Path, tables: Mapping[str, Any]) -> Rig:
    session = parse_session(tables, path.resolve().parent, str(path))
    axes = list(TURNED[session.up])
    cameras = tuple(replace(view.camera, rotation=view.camera.rotation[:, axes]) for view in session.views)
    return _build_fixed_rig(path.resolve().parent.name, session.title, session.fps, cameras)


def _of_calibration(path: Path) -> Rig:
    cameras = read_calibration_toml(path)
    check_rig(path, cameras)
    return _build_fixed_rig(path.stem, f"The cameras of {path.name}", USUAL_FPS, tuple(_sized(path, camera) for camera in cameras))


def _sized(path: Path, camera: Calibrated) -> CameraSpec:
    if camera.size_px is None:
        raise input_error(f"{path}: camera '{camera.name}'", "no image size", "width and height in pixels", "add its size")
    return camera.spec(camera.size_px)


def _build_fixed_rig(name: str, title: str, fps: float, cameras: tuple[CameraSpec, ...]) -> Rig:
    return Rig(name, title, fps, cameras, (False,) * len(cameras), (None,) * len(cameras), _crossing(cameras))


def _crossing(cameras: Sequence[CameraSpec]) -> NDArray[np.float64]:
    """The point nearest to all optical axes, (3,), metres: least squares, with a weak pull to the usual distance along each axis."""
    normal, target = np.zeros((3, 3)), np.zeros(3)
    for camera in cameras:
        centre, forward = -camera.rotation.T @ camera.translation_m, camera.rotation[2]
        perpendicular = np.eye(3) - np.outer(forward, forward)
        normal += perpendicular + PULL * np.eye(3)
        target += perpendicular @ centre + PULL * (centre + USUAL_DISTANCE_M * forward)
    return np.linalg.solve(normal, target)


def _check_names(path: Path, rig: Rig) -> None:
    for camera in rig.cameras:
        try:
            file_name(camera.name)
        except ValueError as error:
            raise InputError(f"{path}: camera name {error}.") from None
