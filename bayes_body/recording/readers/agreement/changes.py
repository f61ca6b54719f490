r"""Changes of a calibration: from another convention to $X_{camera} = R X_{world} + T$ with y down and z ahead, or to turned or scaled pictures.

A file does not say its convention. `judge` tries the changes where the rays of the keypoints do not meet, and a user asks for one by its name.
With $F = \mathrm{diag}(1, -1, -1)$, which leads from the axes of OpenGL and Blender (y up, the view along -z) to those of OpenCV:

| name | the file has | R, T become |
|---|---|---|
| `inverted` | camera to world | $R^T, -R^T T$ |
| `centres` | T is the camera's centre | $R, -R T$ |
| `transposed` | $R^T$, as MATLAB writes it for rows | $R^T, T$ |
| `opengl` | world to camera, OpenGL's axes | $F R, F T$ |
| `inverted_opengl` | camera to world, OpenGL's axes (Blender's `matrix_world`) | $F R^T, -F R^T T$ |
| `opengl_centres` | world to camera, OpenGL's axes, T is the camera's centre | $F R, -F R T$ |
"""

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy.linalg import rq

from bayes_body.recording.session.session import CameraSpec

type Size = tuple[int, int]

FLIP = np.diag([1.0, -1.0, -1.0])
# A quarter turn clockwise: what was to the right of a picture's middle is below it.
QUARTER = np.array([[0.0, -1.0], [1.0, 0.0]])
# By the number of quarter turns.
ANGLES = {1: "90° clockwise", 2: "180°", 3: "90° counterclockwise"}
# Pose2Sim's conversion of Qualisys's calibrations divides the coefficients by this, as if they were pixels.
SUBPIXELS = 64.0


def _same_size(size_px: Size) -> Size:
    return size_px


class Change(NamedTuple):
    """A change of a calibration.

    Attributes:
        apply: `(camera)` -> the changed camera; its pictures may have another size.
        meaning: what is the matter with the calibration, as a sentence without its full stop.
        calibrated_size: the size of the pictures of the calibration, (width, height), for the size of the pictures that there are.
    """

    apply: Callable[[CameraSpec], CameraSpec]
    meaning: str
    calibrated_size: Callable[[Size], Size] = _same_size

    def for_pictures(self, camera: CameraSpec) -> CameraSpec:
        """Return the changed camera if `size_px` is that of the pictures, and the calibration may belong to others."""
        return self.apply(replace(camera, size_px=self.calibrated_size(camera.size_px)))


def _inverted(camera: CameraSpec) -> CameraSpec:
    return replace(camera, rotation=camera.rotation.T, translation_m=-camera.rotation.T @ camera.translation_m)


def _of_centre(camera: CameraSpec) -> CameraSpec:
    return replace(camera, translation_m=-camera.rotation @ camera.translation_m)


def _transposed(camera: CameraSpec) -> CameraSpec:
    return replace(camera, rotation=camera.rotation.T)


def _flipped(camera: CameraSpec) -> CameraSpec:
    return replace(camera, rotation=FLIP @ camera.rotation, translation_m=FLIP @ camera.translation_m)


def _with_exchanged_centre(camera: CameraSpec) -> CameraSpec:
    return replace(camera, centre_px=camera.centre_px[::-1])


def _with_multiplied_distortion(camera: CameraSpec) -> CameraSpec:
    k1, k2, p1, p2, k3 = (SUBPIXELS * coefficient for coefficient in camera.distortion)
    return replace(camera, distortion=(k1, k2, p1, p2, k3))


def turned(camera: CameraSpec, quarters: int) -> CameraSpec:
    """Return the camera whose pictures are this one's after quarter turns clockwise.

    A pixel (u, v) of a picture of height h goes to (h - 1 - v, u). The lens turns too: radial distortion stays, and (p2, p1) is a vector.
    """
    for _ in range(quarters % 4):
        (width, height), (fx, fy), (cx, cy) = camera.size_px, camera.focal_px, camera.centre_px
        # Pixels are an upper triangle times the ray. After the turn of the pixels it is one again if the ray turns too; with skew by not quite 90°.
        triangle, turn = rq(QUARTER @ [[fx, fx * camera.skew], [0.0, fy]])
        signs = np.sign(np.diag(triangle))
        (fx, skewed), (_, fy) = (triangle * signs).tolist()
        turn = signs[:, None] * turn
        axes = np.eye(3)
        axes[:2, :2] = turn
        k1, k2, p1, p2, k3 = camera.distortion
        p2, p1 = (turn @ [p2, p1]).tolist()
        camera = replace(
            camera,
            size_px=(height, width),
            focal_px=(fx, fy),
            centre_px=(height - 1 - cy, cx),
            skew=skewed / fx,
            distortion=(k1, k2, p1, p2, k3),
            rotation=axes @ camera.rotation,
            translation_m=axes @ camera.translation_m,
        )
    return camera


def scaled(camera: CameraSpec, size_px: Size) -> CameraSpec:
    """Return the camera whose pictures are this one's after a change of their size to (width, height). The first pixel's centre is (0, 0)."""
    factors = np.array(size_px) / camera.size_px
    (fx, fy), (cx, cy) = (factors * camera.focal_px).tolist(), (factors * (np.array(camera.centre_px) + 0.5) - 0.5).tolist()
    return replace(camera, size_px=size_px, focal_px=(fx, fy), centre_px=(cx, cy))


def _turn(quarters: int) -> Change:
    meaning = f"the pictures are turned by {ANGLES[quarters]} against the calibration"
    return Change(lambda camera: turned(camera, quarters), meaning, _exchanged if quarters % 2 else _same_size)


def _exchanged(size_px: Size) -> Size:
    return size_px[1], size_px[0]


def _scale(numerator: int, denominator: int, words: str) -> Change:
    """Return the change to pictures whose sides are that fraction of those of the calibration."""

    def apply(camera: CameraSpec) -> CameraSpec:
        width, height = camera.size_px
        return scaled(camera, (width * numerator // denominator, height * numerator // denominator))

    def calibrated_size(size_px: Size) -> Size:
        return size_px[0] * denominator // numerator, size_px[1] * denominator // numerator

    return Change(apply, f"the pictures have {words} size of those of the calibration", calibrated_size)


# How the rig is placed in the world. One program wrote it, so these are changes of all cameras.
POSES: Mapping[str, Change] = {
    "inverted": Change(_inverted, "rotations and translations lead from the camera to the world"),
    "centres": Change(_of_centre, "the translations are the cameras' centres"),
    "transposed": Change(_transposed, "the rotations are transposed, as MATLAB writes them"),
    "opengl": Change(_flipped, "the cameras have the axes of OpenGL and Blender: y up, the view along -z"),
    "inverted_opengl": Change(
        lambda camera: _flipped(_inverted(camera)), "rotations and translations lead from cameras with the axes of OpenGL and Blender to the world"
    ),
    "opengl_centres": Change(
        lambda camera: _flipped(_of_centre(camera)), "the cameras have the axes of OpenGL and Blender, and the translations are their centres"
    ),
}
# Which picture a calibration belongs to. These may concern a single camera.
VIEWS: Mapping[str, Change] = {
    "turned_90": _turn(1),
    "turned_180": _turn(2),
    "turned_270": _turn(3),
    "exchanged_centre": Change(_with_exchanged_centre, "column and row of the principal point are exchanged"),
}
# The size of that picture. Keypoints of pictures of another size look the same.
SIZES: Mapping[str, Change] = {
    "half_size": _scale(1, 2, "half the"),
    "double_size": _scale(2, 1, "twice the"),
}
CHANGES: Mapping[str, Change] = {
    **POSES,
    **VIEWS,
    **SIZES,
    # Its effect is too small for the rays of keypoints.
    "distortion_64": Change(
        _with_multiplied_distortion, "the distortions were divided by 64, as Pose2Sim's conversion of Qualisys's calibrations does"
    ),
}
