"""The checked calibration of one camera: $X_{camera} = R X_{world} + T$, OpenCV's distortion; metres and pixels.

The readers (`toml`, `qualisys`, `opencv`, `vicon`, and `parsec_files`) convert their formats into this record.
"""

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import fields
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from bayes_body.base.errors import input_error
from bayes_body.recording.readers.faults import Faults
from bayes_body.recording.readers.file_names import composed
from bayes_body.recording.session.lens import lens_faults
from bayes_body.recording.session.schema import rotation_fault
from bayes_body.recording.session.session import CameraSpec

# Outside this range a unit is wrong by a factor of 1000: no laboratory has such distances between cameras.
FARTHEST_M = 100.0
NEAREST_M = 0.05
# A larger number is damage, not a wrong unit.
FARTHEST_SANE_M = 1e6
# No sensor has more pixels along a side than this, and no lens has a longer focal length in pixels.
MOST_PIXELS = 1e6
# How many coefficients OpenCV's distortion models have. Those after the fifth belong to the rational, thin prism and tilted models.
DISTORTION_LENGTHS = (4, 5, 8, 12, 14)
# Largest rounding error between a rotation matrix and the Rodrigues vector beside it. Beyond it they belong to two cameras.
TWICE_TOLERANCE = 1e-3
type Numbers = Sequence[Any] | NDArray[np.floating]
# The session's fields as this module calls them.
LENS_FIELDS = {"focal_px": "focal length", "centre_px": "principal point", "distortion": "distortion"}
AGAIN = "copy it from the calibration again"


class Calibrated(NamedTuple):
    """A calibrated camera without its images.

    Attributes:
        name: the name in the calibration.
        size_px: (width, height) of its images; None if the format does not say.
        focal_px: focal lengths (x, y).
        centre_px: the principal point (column, row).
        skew: alpha_c.
        distortion: (k1, k2, p1, p2, k3).
        rotation: (3, 3), world to camera.
        translation_m: (3,), metres.
        quarter_turns: of the pictures against the calibration, clockwise, as the file says.
    """

    name: str
    size_px: tuple[int, int] | None
    focal_px: tuple[float, float]
    centre_px: tuple[float, float]
    skew: float
    distortion: tuple[float, float, float, float, float]
    rotation: NDArray[np.float64]
    translation_m: NDArray[np.float64]
    quarter_turns: int = 0

    @classmethod
    def from_spec(cls, camera: CameraSpec) -> "Calibrated":
        """Return the record of a session's camera."""
        return cls(*(getattr(camera, field.name) for field in fields(camera)))

    @property
    def viewpoint_m(self) -> NDArray[np.float64]:
        """The camera's centre in the world, (3,), metres."""
        return -self.rotation.T @ self.translation_m

    def spec(self, size_px: tuple[int, int]) -> CameraSpec:
        """The session's camera, for images of that size."""
        numbers = {field.name: getattr(self, field.name) for field in fields(CameraSpec)}
        return CameraSpec(**{**numbers, "size_px": size_px})


def calibrated(
    entry: str,
    name: str,
    size: Sequence[float | int] | None,
    matrix: Numbers,
    distortion: Numbers,
    rotation: Numbers,
    translation_m: Numbers,
) -> Calibrated:
    """Check the numbers of one camera and build its record.

    Args:
        entry: the file and the entry of this camera, as error messages call it.
        name: the camera's name.
        size: width and height, or None.
        matrix: (3, 3), fx, skew, cx; 0, fy, cy; 0, 0, 1; pixels.
        distortion: in OpenCV's order k1, k2, p1, p2, k3; any further ones must be 0.
        rotation: (3, 3), or (3,) as a Rodrigues vector.
        translation_m: (3,), metres.

    Raises:
        FaultyFileError: one sentence for each fault.
    """
    faults, values, coefficients, R, size_px = Faults(), (0.0,) * 5, (0.0,) * 5, np.eye(3), None
    T = np.asarray(translation_m, float).ravel()
    with faults.collect():
        values = _intrinsics(entry, np.asarray(matrix, float))
    with faults.collect():
        coefficients = _distortion(entry, np.asarray(distortion, float).ravel())
    with faults.collect():
        R = rotation_matrix(entry, rotation)
    with faults.collect():
        if T.shape != (3,) or not (np.abs(T) <= FARTHEST_SANE_M).all():
            raise input_error(f"{entry}: translation", _shown(T), "three finite numbers", AGAIN)
    with faults.collect():
        size_px = None if size is None else whole_size(entry, size)
    with faults.collect():
        if not name.strip():
            raise input_error(entry, "a camera without a name", "a name", "name it in the calibration")
    faults.raise_any()
    fx, skew, cx, fy, cy = values
    for field, problem, expected in lens_faults(size_px, (fx, fy), (cx, cy), coefficients) if size_px else ():
        with faults.collect():
            raise input_error(f"{entry}: {LENS_FIELDS[field]}", problem, expected, AGAIN)
    faults.raise_any()
    return Calibrated(composed(name), size_px, (fx, fy), (cx, cy), skew / fx, coefficients, R, T)


def _intrinsics(entry: str, K: NDArray[np.float64]) -> tuple[float, float, float, float, float]:
    """(fx, skew in pixels, cx, fy, cy) of a matrix of intrinsics."""
    subject = f"{entry}: camera matrix"
    if K.shape != (3, 3) or not np.isfinite(K).all() or np.abs(K).max() > MOST_PIXELS:
        raise input_error(subject, _shown(K), f"3 x 3 finite numbers, at most {MOST_PIXELS:g}", AGAIN)
    if not np.allclose(K[[1, 2, 2, 2], [0, 0, 1, 2]], [0, 0, 0, 1], atol=1e-9):
        raise input_error(subject, _shown(K), "fx, skew, cx; 0, fy, cy; 0, 0, 1", "write it by rows, in pixels")
    for axis, focal in zip("xy", (K[0, 0], K[1, 1]), strict=True):
        if not focal >= 1:
            raise input_error(entry, f"focal length {axis} = {focal:g}", "a positive number of pixels", AGAIN)
    return float(K[0, 0]), float(K[0, 1]), float(K[0, 2]), float(K[1, 1]), float(K[1, 2])


def _distortion(entry: str, numbers: NDArray[np.float64]) -> tuple[float, float, float, float, float]:
    subject = f"{entry}: distortion"
    if numbers.size not in (0, *DISTORTION_LENGTHS) or not np.isfinite(numbers).all():
        raise input_error(subject, _shown(numbers), "4 or 5 finite numbers, k1, k2, p1, p2, k3", AGAIN)
    if numbers[5:].any():
        problem = f"{numbers.size} numbers, not all 0 after the fifth: a rational, thin prism or tilted lens"
        raise input_error(
            subject, problem, "at most k1, k2, p1, p2, k3", "calibrate again with OpenCV's plain model, without flags such as CALIB_RATIONAL_MODEL"
        )
    k1, k2, p1, p2, k3 = np.pad(numbers[:5], (0, 5 - min(numbers.size, 5))).tolist()
    return k1, k2, p1, p2, k3


def rotation_matrix(entry: str, rotation: Numbers) -> NDArray[np.float64]:
    """The rotation, (3, 3), from a matrix given by rows or from a Rodrigues vector (3).

    Raises:
        InputError: it is neither, or the matrix is not a rotation.
    """
    subject, numbers = f"{entry}: rotation", np.asarray(rotation, float)
    if numbers.size not in (3, 9) or not np.isfinite(numbers).all() or np.abs(numbers).max() > MOST_PIXELS:
        raise input_error(subject, _shown(numbers), "9 finite numbers by rows, or 3 of a Rodrigues vector", AGAIN)
    R = numbers.reshape(3, 3) if numbers.size == 9 else np.asarray(cv2.Rodrigues(numbers.reshape(3, 1))[0], np.float64)
    fault = rotation_fault(R)
    if fault:
        problem, expected, remedy = fault.split("; ")
        raise input_error(subject, problem, expected.removeprefix("expected "), remedy)
    return R


def rotation_given_twice(entry: str, matrix: Numbers, vector: Numbers) -> NDArray[np.float64]:
    """The rotation given both as a matrix and as a Rodrigues vector.

    Raises:
        InputError: one of them is not a rotation, or they contradict each other.
    """
    R = rotation_matrix(entry, matrix)
    off = float(np.linalg.norm(rotation_matrix(entry, vector) - R))
    if off > TWICE_TOLERANCE:
        problem = f"the Rodrigues vector contradicts the rotation matrix by {off:.2g}"
        raise input_error(entry, problem, "the same rotation in both", "find out which is right, and compute the other from it")
    return R


def whole_size(entry: str, size: Sequence[float | int]) -> tuple[int, int]:
    """(width, height) as whole numbers.

    Raises:
        InputError: they are not two whole, positive numbers.
    """
    if len(size) != 2 or not all(1 <= side <= MOST_PIXELS and side == int(side) for side in size):
        raise input_error(f"{entry}: image size", _shown(np.asarray(size, float)), "width and height, whole numbers of pixels", AGAIN)
    return int(size[0]), int(size[1])


def check_rig(calibration: object, cameras: Sequence[Calibrated]) -> None:
    """Refuse cameras that cannot belong to one room: duplicate names, or distances with a wrong unit.

    Args:
        calibration: the calibration, as error messages call it.
        cameras: all cameras of the room.

    Raises:
        FaultyFileError: one sentence for each fault.
    """
    faults = Faults()
    for name, count in Counter(camera.name for camera in cameras).items():
        with faults.collect():
            if count > 1:
                raise input_error(f"{calibration}: camera '{name}'", f"{count} cameras have this name", "unique names", "rename all but one")
    with faults.collect():
        _check_distances(calibration, np.array([camera.viewpoint_m for camera in cameras]), np.array([camera.translation_m for camera in cameras]))
    faults.raise_any()


def _check_distances(calibration: object, viewpoints: NDArray[np.float64], translations: NDArray[np.float64]) -> None:
    # A single camera can only be far from the world's origin, and it may stand there.
    middle = viewpoints.mean(axis=0) if len(viewpoints) > 1 else np.zeros(3)
    extent = _extent(viewpoints)
    farthest = max(extent, float(np.linalg.norm(viewpoints - middle, axis=-1).max()))
    expected = f"a room of {NEAREST_M:g} to {FARTHEST_M:g} m"
    if not farthest <= FARTHEST_M:
        problem = f"cameras {farthest:.4g} m apart or from the world's origin"
        raise input_error(calibration, problem, expected, "it looks like a factor of 1000, millimetres read as metres")
    if len(viewpoints) > 1 and extent < NEAREST_M:
        remedy = "it looks like a factor of 1000, metres read as millimetres"
        if NEAREST_M <= _extent(translations) <= FARTHEST_M:
            # Where cameras look at the world's origin from one distance, T is the same for all, as if the centres were.
            remedy = "it looks as if rotations and translations lead from the camera to the world: import with --rig inverted; or with --rig centres"
        raise input_error(calibration, f"all cameras within {extent:.2g} m", expected, remedy)


def _extent(points: NDArray[np.float64]) -> float:
    return float(np.linalg.norm(points[:, None] - points, axis=-1).max())


def _shown(numbers: NDArray[np.float64]) -> str:
    flat = numbers.ravel()
    cut = ", ..." if flat.size > 9 else ""
    shape = " x ".join(str(side) for side in numbers.shape)
    listed = ", ".join(f"{value:g}" if math.isfinite(value) else str(value) for value in flat[:9])
    return f"{shape} numbers ({listed}{cut})" if flat.size else "no numbers"
