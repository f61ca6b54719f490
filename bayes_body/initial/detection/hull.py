r"""The visual hull of silhouettes in several calibrated views (Laurentini 1994; octree as in Szeliski 1993), for masks with holes and stray blobs.

The blurred mask b in [0, 1] of a view gives the evidence $e = \operatorname{logit}(\epsilon + (1 - 2\epsilon) b) / \operatorname{logit}(1 -
\epsilon)$, between -1 and 1. A voxel belongs to the hull if the mean of e at its centre, over the views that show it, is at least 1/2: with two or
three views each must show foreground, with four to seven one may miss it. (On simulated people of the training subjects with poor masks, such hulls
overlap with those of true masks by 0.62 with four views and 0.69 with seven; hulls in which every view decides alone, by 0.58 and 0.49.)

A view in which another person covers a voxel does not show it.

Coarse voxels are kept if e may reach 1/2 within their circumscribed spheres. Each kept voxel is divided into eight, until its side is `VOXEL_M`.
Connected voxels (26 neighbours) make one body.

The file also has the rays through pixels, and the points where the rays of two views meet.
"""

from collections.abc import Sequence
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Bool, Float
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree

from bayes_body.recording.readers.keypoints.triangulate import project, triangulate
from bayes_body.recording.session.session import CameraSpec

VOXEL_M = 0.03
LEVELS = 4
# The searched box extends by this much around the cameras and the point that they look at, metres.
MARGIN_M = 1.5
# With more voxels than this, the silhouettes fill the images and do not show a person.
MOST_VOXELS = 400_000
# Specks of fewer pixels than this share of the image are removed, and holes up to this share of the image's height are closed.
SPECK, HOLE = 1e-4, 0.015
# Probability that a pixel's mask is wrong, the blur's standard deviation as a share of the image's height, and the least mean evidence.
EPSILON, BLUR, LEAST_EVIDENCE = 0.15, 0.006, 0.5

type Mask = Bool[np.ndarray, "row column"]
type Voxels = Float[np.ndarray, "_ 3"]


class _View(NamedTuple):
    """One view: the evidence of each pixel, its distance to what may be foreground, the blur's reach, pixels, and where others cover it."""

    camera: CameraSpec
    evidence: Float[np.ndarray, "row column"]
    distance: Float[np.ndarray, "row column"]
    blur: float
    covered: Mask | None


def clean(mask: Mask) -> Mask:
    """Return the mask without specks and with its small holes closed."""
    size = max(3, round(HOLE * mask.shape[0]) | 1)
    closed = cv2.morphologyEx(mask.astype(np.uint8), cv2.MORPH_CLOSE, np.ones((size, size), np.uint8))
    _, labels, stats, _ = cv2.connectedComponentsWithStats(closed)
    large = np.asarray(stats[:, cv2.CC_STAT_AREA] >= SPECK * mask.size)
    large[0] = False
    return large[np.asarray(labels, np.intp)]


def carve(cameras: Sequence[CameraSpec], masks: Sequence[Mask], covered: Sequence[Mask | None] | None = None) -> Voxels:
    """Return the centres of the hull's voxels, metres; none if the silhouettes fill the images. Each of two or more cameras has a mask.

    What other people cover (`covered`, None for a view without any) is not seen.
    """
    views = [_view(*view) for view in zip(cameras, masks, covered or [None] * len(masks), strict=True)]
    side = VOXEL_M * 2**LEVELS
    low, high = searched_box(cameras)
    axes = [np.arange(a + side / 2, b + side / 2, side) for a, b in zip(low, high, strict=True)]
    centres = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    halves = np.stack(np.meshgrid(*[[-1, 1]] * 3, indexing="ij"), axis=-1).reshape(-1, 3) / 4
    while side > 1.5 * VOXEL_M:
        centres = centres[_occupied(views, centres, side * np.sqrt(3) / 2)]
        if 8 * len(centres) > MOST_VOXELS:
            return np.zeros((0, 3))
        centres, side = (centres[:, None] + side * halves).reshape(-1, 3), side / 2
    return centres[_occupied(views, centres, 0.0)]


def bodies(centres: Voxels) -> list[Voxels]:
    """Return the connected bodies of a hull, the largest first."""
    if not len(centres):
        return []
    labels = connected_components(neighbours(centres), directed=False)[1]
    return sorted((centres[labels == k] for k in range(labels.max() + 1)), key=len, reverse=True)


def neighbours(centres: Voxels) -> coo_array:
    """Return the graph of neighbouring voxels (faces, edges and corners) with their distances, metres, as an upper triangular matrix."""
    pairs = KDTree(centres).query_pairs(1.8 * VOXEL_M, output_type="ndarray")
    lengths = np.linalg.norm(centres[pairs[:, 0]] - centres[pairs[:, 1]], axis=1)
    return coo_array((lengths, (pairs[:, 0], pairs[:, 1])), shape=(len(centres), len(centres)))


def searched_box(cameras: Sequence[CameraSpec]) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"]]:
    """Return the lowest and the highest corner of the searched box: it holds the cameras and the point nearest to all their axes, with a margin."""
    places = np.stack([-camera.rotation.T @ camera.translation_m for camera in cameras])
    axes = np.stack([camera.rotation[2] for camera in cameras])
    perpendicular = np.eye(3) - axes[:, :, None] * axes[:, None]
    # The small ridge is for parallel axes, which meet nowhere.
    ridge = 1e-2 * np.eye(3)
    in_front = places.mean(axis=0) + 3.0 * axes.mean(axis=0)
    middle = np.linalg.solve(perpendicular.sum(axis=0) + ridge, (perpendicular @ places[:, :, None]).sum(axis=0)[:, 0] + ridge @ in_front)
    corners = np.concatenate([places, middle[None]])
    return corners.min(axis=0) - MARGIN_M, corners.max(axis=0) + MARGIN_M


def _view(camera: CameraSpec, mask: Mask, covered: Mask | None) -> _View:
    blur = BLUR * mask.shape[0]
    blurred = EPSILON + (1 - 2 * EPSILON) * cv2.GaussianBlur(mask.astype(np.float32), (0, 0), blur)
    evidence = np.log(blurred / (1 - blurred)) / np.log((1 - EPSILON) / EPSILON)
    surely_empty = ~mask if covered is None else ~(mask | covered)
    return _View(camera, evidence, cv2.distanceTransform(surely_empty.astype(np.uint8), cv2.DIST_L2, 3), 3 * blur, covered)


def _occupied(views: Sequence[_View], centres: Voxels, radius_m: float) -> Bool[np.ndarray, " voxel"]:
    """Return which voxels belong to the hull; with a radius, which may have parts that do. At least half of the views must show a voxel."""
    view_counts, evidence = np.zeros(len(centres), int), np.zeros(len(centres))
    for camera, map_, distance, blur, covered in views:
        height, width = map_.shape
        # Far outside an image, pixels may be infinite.
        columns, rows = np.clip(np.nan_to_num(project(camera, centres), nan=-1e6, posinf=-1e6), -1e6, 1e6).T
        depth = np.maximum(centres @ camera.rotation[2] + camera.translation_m[2], VOXEL_M)
        reach = max(camera.focal_px) * radius_m / depth
        inside = (columns > -0.5 - reach) & (columns < width - 0.5 + reach) & (rows > -0.5 - reach) & (rows < height - 0.5 + reach)
        indices = np.clip(np.rint(rows), 0, height - 1).astype(int), np.clip(np.rint(columns), 0, width - 1).astype(int)
        # A coarse voxel's covered views count as foreground: that is never less than without them.
        if covered is not None and not radius_m:
            inside &= ~covered[indices]
        view_counts += inside
        evidence += inside * (np.where(distance[indices] <= reach + blur, 1.0, -1.0) if radius_m else map_[indices])
    return (view_counts >= max(2, len(views) / 2)) & (evidence >= LEAST_EVIDENCE * view_counts)


def rays(camera: CameraSpec, pixels: Float[np.ndarray, "point 2"]) -> Float[np.ndarray, "point 3"]:
    """Return unit vectors in the world from the camera's centre through pixels (column, row)."""
    xy = (pixels - camera.centre_px) / camera.focal_px
    xy[:, 0] -= camera.skew * xy[:, 1]
    if len(xy):
        xy = cv2.undistortPoints(xy[:, None], np.eye(3), np.array(camera.distortion))[:, 0]
    directions = np.column_stack([xy, np.ones(len(xy))]) @ camera.rotation
    return directions / np.linalg.norm(directions, axis=1, keepdims=True)


def triangulate_pair(
    cameras: Sequence[CameraSpec], first: Float[np.ndarray, "point 2"], second: Float[np.ndarray, "point 2"]
) -> tuple[Float[np.ndarray, "point 3"], Float[np.ndarray, " point"]]:
    """Return where the rays of two cameras' pixels meet, metres, and the RMS distance in the images, pixels; NaN where they do not meet."""
    observations = np.stack([np.column_stack([pixels, np.ones(len(pixels))]) for pixels in (first, second)])
    triangulation = triangulate(cameras, observations)
    return triangulation.points_m, triangulation.error_px
