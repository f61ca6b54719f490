r"""From triangles to samples of a picture: the projection to the image, runs of samples, row by row, and the triangle in front at each.

Where a run starts or ends is computed from the two ends of an edge, with the same arithmetic for both triangles that share it, so no crack opens
between neighbours. Samples lie at whole numbers. A triangle owns the samples from its left edge (included) to its right edge (excluded).

The projection is implemented independently of the model. It is Bouguet's pinhole with radial and tangential distortion:
$x = X/Z,\ y = Y/Z,\ r^2 = x^2 + y^2$; $d = 1 + k_1 r^2 + k_2 r^4 + k_3 r^6$;
$x' = d x + 2 p_1 x y + p_2 (r^2 + 2 x^2)$, $y' = d y + p_1 (r^2 + 2 y^2) + 2 p_2 x y$;
column $= f_x (x' + \alpha y') + c_x$, row $= f_y y' + c_y$ (Brown 1966; Bouguet's Camera Calibration Toolbox).
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from bayes_body.recording.session.session import CameraSpec

# How many times samples that a later triangle took wrongly are corrected; folded skin needs three.
ROUNDS = 8


class Spans(NamedTuple):
    """Runs of samples.

    Attributes:
        face: (span,), index of the triangle.
        row: (span,), the row.
        start: (span,), the first column.
        length: (span,), number of samples; at least 1.
    """

    face: Int[np.ndarray, " span"]
    row: Int[np.ndarray, " span"]
    start: Int[np.ndarray, " span"]
    length: Int[np.ndarray, " span"]


def spans(corners: Float[np.ndarray, "face 3 2"], size: tuple[int, int]) -> Spans:
    """The runs of all triangles in a picture.

    Args:
        corners: column and row of each corner.
        size: (width, height) in samples.
    """
    width, height = size
    order = np.argsort(corners[..., 1], axis=-1)
    top, middle, bottom = np.moveaxis(np.take_along_axis(corners, order[..., None], axis=1), 1, 0)
    first, last = (np.clip(np.ceil(corner[:, 1]), 0, height).astype(np.int32) for corner in (top, bottom))
    face, within = runs(last - first)
    row = first[face] + within
    lower = row >= middle[face, 1]
    long = _crossing(top, bottom, face, row)
    short = np.where(lower, _crossing(middle, bottom, face, row), _crossing(top, middle, face, row))
    start, end = (np.clip(np.ceil(edge(long, short)), 0, width).astype(np.int32) for edge in (np.minimum, np.maximum))
    filled = end > start
    return Spans(face[filled], row[filled], start[filled], (end - start)[filled])


def _crossing(
    high: Float[np.ndarray, "face 2"], low: Float[np.ndarray, "face 2"], face: Int[np.ndarray, " span"], row: Int[np.ndarray, " span"]
) -> Float[np.ndarray, " span"]:
    """Where edges cross a row."""
    fall = low[:, 1] - high[:, 1]
    slope = (low[:, 0] - high[:, 0]) / np.where(fall > 0, fall, 1.0)
    return high[face, 0] + (row - high[face, 1]) * slope[face]


def runs(counts: Int[np.ndarray, " run"]) -> tuple[Int[np.ndarray, " item"], Int[np.ndarray, " item"]]:
    """For every item of consecutive runs with these lengths: the index of its run, and its position in the run."""
    run = np.repeat(np.arange(len(counts), dtype=np.int32), counts)
    return run, np.arange(len(run), dtype=np.int32) - np.repeat((np.cumsum(counts) - counts).astype(np.int32), counts)


def in_front(
    covered: Spans, depth: Float[np.ndarray, "face 3"], size: tuple[int, int]
) -> tuple[Int[np.ndarray, "row column"], Bool[np.ndarray, "row column"]]:
    """The nearest triangle at each sample.

    Args:
        covered: all triangles' runs, the farther ones first.
        depth: each triangle's depth as a plane: slopes by column and by row, and value at (0, 0).
        size: (width, height) in samples.

    Returns:
        The triangle's index (0 where there is none) and whether there is one.
    """
    width, height = size
    run, within = runs(covered.length)
    by_column, by_row, level = (part.astype(np.float32).take(covered.face) for part in depth.T)
    base = by_row * covered.row.astype(np.float32) + by_column * covered.start.astype(np.float32) + level
    distance = base.take(run) + by_column.take(run) * within.astype(np.float32)
    sample = (covered.row * width + covered.start).take(run) + within
    face = covered.face.take(run)
    nearest, owner = np.full(width * height, np.inf, np.float32), np.full(width * height, -1, np.int32)
    # The last of several writers to one sample wins. This is the nearest triangle unless triangles intersect.
    for _ in range(ROUNDS):
        nearest[sample], owner[sample] = distance, face
        nearer = distance < nearest[sample]
        if not nearer.any():
            break
        distance, sample, face = distance[nearer], sample[nearer], face[nearer]
    return np.maximum(owner, 0).reshape(height, width), (owner >= 0).reshape(height, width)


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
