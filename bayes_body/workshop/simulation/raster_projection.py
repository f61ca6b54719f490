r"""Projection of world points to an image, implemented independently of the model: Bouguet's pinhole with radial and tangential distortion.

$x = X/Z,\ y = Y/Z,\ r^2 = x^2 + y^2$; $d = 1 + k_1 r^2 + k_2 r^4 + k_3 r^6$;
$x' = d x + 2 p_1 x y + p_2 (r^2 + 2 x^2)$, $y' = d y + p_1 (r^2 + 2 y^2) + 2 p_2 x y$;
column $= f_x (x' + \alpha y') + c_x$, row $= f_y y' + c_y$ (Brown 1966; Bouguet's Camera Calibration Toolbox).
"""

import numpy as np
from jaxtyping import Bool, Float

from bayes_body.recording.session.session import CameraSpec

# Nothing nearer than this is visible.
NEAR_M = 0.1
# The radial polynomial is used only up to where it stops growing; beyond, it would fold the far side of the world into the picture.
FARTHEST_SLOPE = 4.0


def project(
    points: Float[np.ndarray, "point 3"], camera: CameraSpec
) -> tuple[Float[np.ndarray, "point 2"], Float[np.ndarray, " point"], Bool[np.ndarray, " point"]]:
    """Column and row (pixels; the first pixel's centre is (0, 0)), depth (metres), and whether the camera can see in that direction at all."""
    p_camera = points @ camera.rotation.T + camera.translation_m
    depth = p_camera[:, 2]
    slopes = p_camera[:, :2] / np.maximum(depth, NEAR_M)[:, None]
    squared = np.sum(slopes**2, axis=1)
    visible = (depth > NEAR_M) & (squared < _largest_slope(camera) ** 2)
    # Values beyond the valid range are not used, but must stay finite.
    slopes = np.where(visible[:, None], slopes, 0.0)
    x, y = slopes.T
    squared = np.where(visible, squared, 0.0)
    k1, k2, p1, p2, k3 = camera.distortion
    radial = 1.0 + squared * (k1 + squared * (k2 + squared * k3))
    bent_x = radial * x + 2.0 * p1 * x * y + p2 * (squared + 2.0 * x * x)
    bent_y = radial * y + p1 * (squared + 2.0 * y * y) + 2.0 * p2 * x * y
    column = camera.focal_px[0] * (bent_x + camera.skew * bent_y) + camera.centre_px[0]
    row = camera.focal_px[1] * bent_y + camera.centre_px[1]
    return np.stack([column, row], axis=1), depth, visible


def _largest_slope(camera: CameraSpec) -> float:
    """The slope up to which the radial polynomial r d(r) grows."""
    k1, k2, _, _, k3 = camera.distortion
    slopes = np.linspace(0.0, FARTHEST_SLOPE, 401)
    falls = np.flatnonzero(1.0 + 3.0 * k1 * slopes**2 + 5.0 * k2 * slopes**4 + 7.0 * k3 * slopes**6 <= 0.0)
    return float(slopes[falls[0]]) if len(falls) else FARTHEST_SLOPE
