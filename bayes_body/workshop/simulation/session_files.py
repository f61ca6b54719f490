"""Write files of a simulated session: videos, silhouettes, keypoints, calibration as Pose2Sim has it, extrinsics of moving cameras, and the truth.

Videos are MPEG-4 in .mp4, which every OpenCV can write; silhouettes are numbered. Failures raise an InputError.
"""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import cv2
import numpy as np
import tomlkit
from jaxtyping import Bool, Float, UInt8
from tomlkit.items import Table

from bayes_body.base.errors import InputError, input_error
from bayes_body.base.files.atomic import make_folder, replacing, write_text
from bayes_body.recording.evidence.markers import MARKERS
from bayes_body.recording.readers.images import SILENT
from bayes_body.recording.readers.keypoints.openpose import LAYOUTS
from bayes_body.recording.readers.keypoints.series import MARKERS as MARKERS_OF_POINTS
from bayes_body.recording.session.session import CameraSpec

# Where Pose2Sim expects a project's calibration.
CALIBRATION, TRUTH = "calibration/Calib.toml", "truth.npz"


def camera_name(name: str) -> str:
    """A moving camera's extrinsics, relative to the session's folder."""
    return f"cameras/{name}.npz"


def write_calibration(path: Path, cameras: Sequence[CameraSpec]) -> None:
    """Write cameras as a Pose2Sim calibration: metres, `X_camera = R X_world + T`, R as a Rodrigues vector.

    Raises:
        InputError: it cannot be written.
    """
    text = tomlkit.document()
    for camera in cameras:
        text.add(camera.name, _calibration(camera))
    metadata = tomlkit.table()
    metadata.add("adjusted", False)
    metadata.add("error", 0.0)
    text.add("metadata", metadata)
    make_folder(path.parent)
    write_text(path, tomlkit.dumps(text))


def _calibration(camera: CameraSpec) -> Table:
    focal, centre = camera.focal_px, camera.centre_px
    matrix = [[focal[0], camera.skew * focal[0], centre[0]], [0.0, focal[1], centre[1]], [0.0, 0.0, 1.0]]
    # Pose2Sim reads four coefficients; a fifth is written only if it is not zero.
    distortions = list(camera.distortion if camera.distortion[4] else camera.distortion[:4])
    table = tomlkit.table()
    table.add("name", camera.name)
    table.add("size", [float(side) for side in camera.size_px])
    table.add("matrix", matrix)
    table.add("distortions", distortions)
    table.add("rotation", np.asarray(cv2.Rodrigues(camera.rotation)[0]).ravel().tolist())
    table.add("translation", np.asarray(camera.translation_m).tolist())
    table.add("fisheye", False)
    return table


def write_truth(
    path: Path, markers: Float[np.ndarray, "frame 15 3"], landmarks: Mapping[str, Float[np.ndarray, "frame 3"]], more: Mapping[str, np.ndarray]
) -> None:
    """Write the true markers and all landmarks (toes, finger ends) with their names, and further arrays; metres.

    Raises:
        InputError: it cannot be written.
    """
    points = np.stack([np.asarray(track, np.float64) for track in landmarks.values()], axis=1)
    arrays: dict[str, Any] = {
        "markers": markers,
        "names": np.array(MARKERS),
        "landmarks": points,
        "landmark_names": np.array(list(landmarks)),
        **more,
    }
    with replacing(path) as partial:
        np.savez(partial, **arrays)


def write_extrinsics(path: Path, cameras: Sequence[CameraSpec]) -> None:
    """Write a moving camera's `rotation` (frame, 3, 3) and `translation_m` (frame, 3), `X_camera = rotation X_world + translation_m`.

    Raises:
        InputError: it cannot be written.
    """
    make_folder(path.parent)
    with replacing(path) as partial:
        np.savez(
            partial, rotation=np.stack([camera.rotation for camera in cameras]), translation_m=np.stack([camera.translation_m for camera in cameras])
        )


# The layout whose points include all markers.
LAYOUT = "HALPE_26"


def write_detections(folder: Path, name: str, frame: int, people: Float[np.ndarray, "detection 15 3"]) -> None:
    """Write the detections of a camera in a frame as OpenPose writes them, in the order `LAYOUT`.

    Args:
        folder: the camera's folder, which exists.
        name: the camera's name.
        frame: the frame number.
        people: column, row, confidence of the markers; NaN where not detected.

    Raises:
        InputError: it cannot be written.
    """
    points = [MARKERS_OF_POINTS.get(point, point) for point in LAYOUTS[LAYOUT]]
    rows = np.zeros((len(people), len(points), 3))
    for column, point in enumerate(points):
        if point in MARKERS:
            rows[:, column] = np.nan_to_num(people[:, MARKERS.index(point)]).round(3)
    persons = [{"person_id": [-1], "pose_keypoints_2d": row.ravel().tolist()} for row in rows]
    write_text(folder / f"{name}_{frame:012d}_keypoints.json", json.dumps({"version": 1.3, "people": persons}))


CODEC = "mp4v"


class VideoWriter:
    """A video that is written frame by frame; the file is complete after closing."""

    def __init__(self, path: Path, fps: float, size_px: tuple[int, int]):
        """Open a video.

        Args:
            path: its file; the folder is created if needed.
            fps: frames per second.
            size_px: (width, height).

        Raises:
            InputError: it cannot be written.
        """
        make_folder(path.parent)
        with SILENT:
            self._video = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*CODEC), fps, size_px)
        self._path = path
        if not self._video.isOpened():
            raise _refused(path, "cannot be opened for writing")

    def add(self, picture: UInt8[np.ndarray, "row column 3"]) -> None:
        """Write the next frame: blue, green, red."""
        self._video.write(picture)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        """Close the file. OpenCV does not report a full disk, so check that the file is not empty."""
        self._video.release()
        if error is None and not (self._path.is_file() and self._path.stat().st_size):
            raise _refused(self._path, "is empty")


def write_mask(pattern: Path, number: int, mask: Bool[np.ndarray, "row column"]) -> None:
    """Write a silhouette, white where the person is.

    Args:
        pattern: pattern of the file's name, with one place for the number; its folder exists.
        number: the frame number.
        mask: the silhouette.

    Raises:
        InputError: it cannot be written.
    """
    path = Path(str(pattern) % number)
    if not cv2.imwrite(str(path), mask.astype(np.uint8) * 255):
        raise _refused(path, "cannot be written")


def _refused(path: Path, problem: str) -> InputError:
    return input_error(path, problem, "a writable folder with free space", "name another folder, or free some space")
