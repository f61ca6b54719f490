"""Points of two views: their rays, and where the rays meet."""

from collections.abc import Sequence

import cv2
import numpy as np
from jaxtyping import Float

from bayes_body.recording.readers.triangulate import triangulate
from bayes_body.recording.session.session import CameraSpec


def rays(camera: CameraSpec, pixels: Float[np.ndarray, "point 2"]) -> Float[np.ndarray, "point 3"]:
    """Unit vectors in the world from the camera's centre through pixels (column, row)."""
    xy = (pixels - camera.centre_px) / camera.focal_px
    xy[:, 0] -= camera.skew * xy[:, 1]
    if len(xy):
        xy = cv2.undistortPoints(xy[:, None], np.eye(3), np.array(camera.distortion))[:, 0]
    directions = np.column_stack([xy, np.ones(len(xy))]) @ camera.rotation
    return directions / np.linalg.norm(directions, axis=1, keepdims=True)


def triangulate_pair(
    cameras: Sequence[CameraSpec], first: Float[np.ndarray, "point 2"], second: Float[np.ndarray, "point 2"]
) -> tuple[Float[np.ndarray, "point 3"], Float[np.ndarray, " point"]]:
    """Where the rays of two cameras' pixels meet, metres, and the root mean square distance in the images, pixels; NaN where they do not meet."""
    observations = np.stack([np.column_stack([pixels, np.ones(len(pixels))]) for pixels in (first, second)])
    triangulation = triangulate(cameras, observations)
    return triangulation.points_m, triangulation.error_px
