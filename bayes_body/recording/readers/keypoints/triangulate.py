r"""Triangulate points from several calibrated cameras (direct linear transformation), robust against a camera that is wrong.

An undistorted ray $(x, y)$ with weight w gives $w (x P_3 - P_1) X = 0,\ w (y P_3 - P_2) X = 0$ with P = [R | T]. X is the right singular vector of
the smallest singular value (Hartley & Zisserman, 12.2). Dividing w by the point's depth, once it is known, turns the residual into one in the image.

Every pair of cameras proposes a point. The proposal with the smallest sum of squared errors wins; each error is capped at the tolerance.
The cameras within the tolerance then determine the final point. If fewer than two cameras agree, the point is NaN.
"""

from collections.abc import Sequence
from itertools import combinations
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Bool, Float

from bayes_body.recording.session.session import CameraSpec

# Default tolerance, as a fraction of the image's diagonal: 16 px in 640 x 480, 44 px in 1920 x 1080.
TOLERANCE = 0.02
# A point nearer to a camera's plane than this (metres) counts as behind it.
NEAR_M = 0.05
NO_TURN, UNIT = np.zeros(3), np.eye(3)
# Points that pairs of cameras propose at a time.
MOST_AT_ONCE = 50_000
UNDISTORTION = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 50, 1e-12)


class Triangulated(NamedTuple):
    """Points of the world.

    Attributes:
        points_m: positions, metres; NaN where no two cameras agree.
        error_px: root mean square reprojection error of the cameras that were used, pixels; NaN with the point.
        used: which cameras agree on which point.
    """

    points_m: Float[np.ndarray, "point 3"]
    error_px: Float[np.ndarray, " point"]
    used: Bool[np.ndarray, "camera point"]


def triangulate(cameras: Sequence[CameraSpec], image_points: Float[np.ndarray, "camera point 3"], tolerance_px: float | None = None) -> Triangulated:
    """Triangulate points from column, row (pixels; NaN where not seen) and confidence, which is used as a weight.

    Args:
        cameras: at least two.
        image_points: the points in each camera.
        tolerance_px: the largest error of a camera that agrees; None: 2 % of the images' diagonal.
    """
    tolerance = TOLERANCE * float(np.mean([np.hypot(*camera.size_px) for camera in cameras])) if tolerance_px is None else tolerance_px
    weights, rays = _weighted_rays(cameras, image_points)
    pairs = list(combinations(range(len(cameras)), 2))
    best = np.full(image_points.shape[1], np.inf)
    agreeing = np.zeros(weights.shape, bool)
    # Pairs at once, unless they are many.
    size = max(1, MOST_AT_ONCE // max(image_points.shape[1], 1))
    for start in range(0, len(pairs), size):
        cost, within = _proposed(cameras, rays, weights, image_points, pairs[start : start + size], tolerance)
        first = cost.argmin(axis=0)
        least = np.take_along_axis(cost, first[None], axis=0)[0]
        better = least < best
        best = np.where(better, least, best)
        agreeing = np.where(better, np.take_along_axis(within, first[None, None], axis=1)[:, 0], agreeing)
    agreeing &= agreeing.sum(axis=0) >= 2
    return _settled(cameras, rays, image_points, np.where(agreeing, weights, 0.0))


def _proposed(
    cameras: Sequence[CameraSpec],
    rays: Float[np.ndarray, "camera point 2"],
    weights: Float[np.ndarray, "camera point"],
    image_points: Float[np.ndarray, "camera point 3"],
    pairs: Sequence[tuple[int, int]],
    tolerance: float,
) -> tuple[Float[np.ndarray, "pair point"], Bool[np.ndarray, "camera pair point"]]:
    """The costs of the points that pairs of cameras propose, and which cameras are within the tolerance of them."""
    chosen = np.zeros((len(cameras), len(pairs), rays.shape[1]))
    for i, pair in enumerate(pairs):
        chosen[list(pair), i] = weights[list(pair)]
    points = _solve(cameras, rays, chosen)
    # A single ray proposes any of its points.
    possible = (chosen > 0).sum(axis=0) == 2
    pixels = np.stack([project(camera, points.reshape(-1, 3)) for camera in cameras]).reshape(*chosen.shape, 2)
    errors = np.linalg.norm(pixels - image_points[:, None, :, :2], axis=-1)
    seen = weights[:, None] > 0
    cost = (weights[:, None] * np.where(seen, np.minimum(errors, tolerance), 0.0) ** 2).sum(axis=0)
    return np.where(possible, cost, np.inf), seen & (errors <= tolerance)


def triangulate_from_all(cameras: Sequence[CameraSpec], image_points: Float[np.ndarray, "camera point 3"]) -> Float[np.ndarray, "point 3"]:
    """Triangulate points from all cameras that see them, in a seventh of the time of `triangulate` for four: one wrong camera moves the point.

    Args:
        cameras: at least two.
        image_points: column, row (pixels; NaN where not seen) and confidence, which is used as a weight.

    Returns:
        Positions, metres; NaN where fewer than two cameras see the point.
    """
    weights, rays = _weighted_rays(cameras, image_points)
    return np.where((weights > 0).sum(axis=0)[:, None] >= 2, _solve(cameras, rays, weights), np.nan)


def _weighted_rays(
    cameras: Sequence[CameraSpec], image_points: Float[np.ndarray, "camera point 3"]
) -> tuple[Float[np.ndarray, "camera point"], Float[np.ndarray, "camera point 2"]]:
    weights = np.where(np.isfinite(image_points).all(axis=-1) & (image_points[..., 2] > 0), image_points[..., 2], 0.0)
    return weights, np.stack([undistorted_rays(camera, points) for camera, points in zip(cameras, image_points[..., :2], strict=True)])


def _settled(
    cameras: Sequence[CameraSpec],
    rays: Float[np.ndarray, "camera point 2"],
    image_points: Float[np.ndarray, "camera point 3"],
    weights: Float[np.ndarray, "camera point"],
) -> Triangulated:
    used = weights > 0
    points = np.where(used.any(axis=0)[:, None], _solve(cameras, rays, weights), np.nan)
    errors = np.where(used, reprojection_errors(cameras, points, image_points), 0.0)
    with np.errstate(invalid="ignore"):
        return Triangulated(points, np.sqrt((errors**2).sum(axis=0) / used.sum(axis=0)), used)


def _solve(
    cameras: Sequence[CameraSpec], rays: Float[np.ndarray, "camera point 2"], weights: Float[np.ndarray, "camera *choice point"]
) -> Float[np.ndarray, "*choice point 3"]:
    """The weighted points, for one or more choices of weights; a camera with weight 0 has no influence."""
    P = np.stack([np.column_stack([camera.rotation, camera.translation_m]) for camera in cameras])
    rows = np.nan_to_num(rays)[..., None] * P[:, None, 2:] - P[:, None, :2]
    # The right singular vectors of A are the eigenvectors of A^T A, which is much smaller.
    squares = rows.swapaxes(-1, -2) @ rows
    scale = weights
    points = np.zeros((*weights.shape[1:], 3))
    for _ in range(3):
        X = np.linalg.eigh(np.einsum("c...p,cpij->...pij", scale**2, squares))[1][..., 0]
        points = X[..., :3] / np.where(np.abs(X[..., 3:]) < 1e-12, 1e-12, X[..., 3:])
        depth = np.einsum("ci,...pi->c...p", P[:, 2, :3], points) + P[:, 2, 3].reshape(-1, *(1,) * (points.ndim - 1))
        scale = weights / np.maximum(np.abs(depth), NEAR_M)
    return points


def reprojection_errors(
    cameras: Sequence[CameraSpec], points_m: Float[np.ndarray, "point 3"], image_points: Float[np.ndarray, "camera point 3"]
) -> Float[np.ndarray, "camera point"]:
    """Distance in the image (pixels) between projected points and what each camera sees; infinite behind a camera, NaN where not seen."""
    return np.stack(
        [np.linalg.norm(project(camera, points_m) - pixels[:, :2], axis=-1) for camera, pixels in zip(cameras, image_points, strict=True)]
    )


def project(camera: CameraSpec, points_m: Float[np.ndarray, "point 3"]) -> Float[np.ndarray, "point 2"]:
    """Project points of the world to column and row, pixels; infinite behind the camera, NaN for a point that is NaN."""
    points = points_m @ camera.rotation.T + camera.translation_m
    behind = points[:, 2] <= NEAR_M
    in_front = np.where(behind[:, None] | np.isnan(points), [0.0, 0.0, 1.0], points)
    if not len(in_front):
        return np.zeros((0, 2))
    xy = cv2.projectPoints(in_front, NO_TURN, NO_TURN, UNIT, np.array(camera.distortion))[0][:, 0]
    # OpenCV's projection has no skew.
    x = xy[:, 0] + camera.skew * xy[:, 1]
    pixels = np.stack([x, xy[:, 1]], axis=-1) * camera.focal_px + camera.centre_px
    pixels[behind] = np.inf
    pixels[np.isnan(points).any(axis=1)] = np.nan
    return pixels


def undistorted_rays(camera: CameraSpec, pixels: Float[np.ndarray, "point 2"]) -> Float[np.ndarray, "point 2"]:
    """Undistorted (x, y) at depth 1 in the camera's frame; NaN where not seen."""
    xy = (pixels - camera.centre_px) / camera.focal_px
    xy[:, 0] -= camera.skew * xy[:, 1]
    is_measured = np.isfinite(xy).all(axis=1)
    if is_measured.any():
        inside = xy[is_measured][:, None]
        xy[is_measured] = cv2.undistortPointsIter(inside, UNIT, np.array(camera.distortion), UNIT, UNIT, UNDISTORTION)[:, 0]
    return xy
