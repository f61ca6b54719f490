"""Points on the outline of a silhouette, beside it and elsewhere, and the filter responses there."""

from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates

from bayes_body.recording.evidence.edge_phase import Response, steer

# Distance in pixels between two points along an outline, and between an outline and points elsewhere.
SPACING_PX, ELSEWHERE_PX = 4, 12
# The outline of a pixel mask has corners; normals are computed after smoothing by this standard deviation.
SMOOTH_PX = 2.5


class Points(NamedTuple):
    """Points in an image: column and row, and the unit vectors along which filters are steered."""

    places: Float[np.ndarray, "point 2"]
    normals: Float[np.ndarray, "point 2"]


def outline_points(mask: NDArray[np.bool_]) -> Points:
    """The outline of a silhouette (row, column), sampled every few pixels on pixel edges; parts on the image border are left out."""
    smooth = cv2.GaussianBlur(mask.astype(np.float32), (0, 0), SMOOTH_PX)
    slope = np.stack([cv2.Sobel(smooth, cv2.CV_32F, 1, 0), cv2.Sobel(smooth, cv2.CV_32F, 0, 1)], axis=-1)
    contours, _ = cv2.findContours(mask.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    pixels = np.concatenate([contour[::SPACING_PX, 0] for contour in contours] or [np.zeros((0, 2), int)])
    rows, columns = mask.shape
    margin = np.ceil(3 * SMOOTH_PX)
    inside = np.all((pixels >= margin) & (pixels < np.array([columns, rows]) - margin), axis=1)
    pixels = pixels[inside]
    outward = -slope[pixels[:, 1], pixels[:, 0]]
    length = np.linalg.norm(outward, axis=1)
    known = length > 1e-6
    normals = outward[known] / length[known, None]
    # A contour follows the last pixels inside: the edge is half a pixel further out.
    return Points(pixels[known] + 0.5 * normals, normals)


def elsewhere_points(mask: NDArray[np.bool_], number: int, rng: np.random.Generator) -> Points:
    """Random points near a person but not on the outline, with random directions; none if there is no person."""
    if not mask.any():
        return Points(np.zeros((0, 2)), np.zeros((0, 2)))
    distance = cv2.distanceTransform((~mask).astype(np.uint8), cv2.DIST_L2, 5) + cv2.distanceTransform(mask.astype(np.uint8), cv2.DIST_L2, 5)
    height = np.ptp(np.nonzero(mask.any(axis=1))[0])
    rows, columns = np.nonzero((distance >= ELSEWHERE_PX) & (distance <= max(height / 3, 2 * ELSEWHERE_PX)))
    chosen = rng.choice(len(rows), min(number, len(rows)), replace=False) if len(rows) else np.zeros(0, int)
    angle = rng.uniform(0, np.pi, len(chosen))
    return Points(np.stack([columns[chosen], rows[chosen]], axis=1).astype(float), np.stack([np.cos(angle), np.sin(angle)], axis=1))


def displaced(points: Points, by_px: float, rng: np.random.Generator) -> Points:
    """The points moved along their normals, each to a random side."""
    sides = rng.choice([-1.0, 1.0], len(points.places))
    return points._replace(places=points.places + by_px * sides[:, None] * points.normals)


def sampled(maps: Float[np.ndarray, "map row column"], points: Points) -> Response:
    """The responses in one image at the points, interpolated bilinearly as in the likelihood."""
    where = points.places.T[::-1]
    values = [map_coordinates(response_map, where, order=1, mode="nearest") for response_map in maps]
    return steer(values, points.normals[:, 0], points.normals[:, 1])
