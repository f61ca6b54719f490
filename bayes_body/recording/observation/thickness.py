"""Spread points over a silhouette so that a limb gets points in proportion to its length. By area, a torso would get most of them, and an arm few."""

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int


def local_thickness(mask: Bool[np.ndarray, "row column"]) -> Float[np.ndarray, "row column"]:
    """At each pixel: the radius of the largest disc inside the foreground that contains it, pixels (Hildebrand & Rüegsegger 1997); 0 outside."""
    # Add a border of background: a silhouette cut by the image's edge counts as thick as its visible part.
    inside = cv2.distanceTransform(np.pad(mask.astype(np.uint8), 1), cv2.DIST_L2, 5)[1:-1, 1:-1]
    thickness = inside.copy()
    rows, columns = np.nonzero(_ridge(inside))
    radii = inside[rows, columns]
    for k in np.argsort(radii):
        # Draw smaller discs first, so that larger ones overwrite them.
        cv2.circle(thickness, (int(columns[k]), int(rows[k])), int(radii[k]), float(radii[k]), cv2.FILLED)
    return np.where(mask, thickness, 0).astype(np.float32)


def _ridge(inside: Float[np.ndarray, "row column"]) -> Bool[np.ndarray, "row column"]:
    """Where the distance to the background is no smaller than on both sides, along rows or along columns."""
    wide = np.pad(inside, 1)
    across = (inside >= wide[1:-1, :-2]) & (inside >= wide[1:-1, 2:])
    upright = (inside >= wide[:-2, 1:-1]) & (inside >= wide[2:, 1:-1])
    return (inside > 0) & (across | upright)


def spread_points(mask: Bool[np.ndarray, "row column"], count: int) -> Float[np.ndarray, "point 2"]:
    """`count` pixels of a mask, each for an equal share of area divided by thickness: (point, 2), column and row relative to the image's centre.

    All are 0 if the mask is empty.
    """
    if not count:
        return np.zeros((0, 2), np.float32)
    # Crop to the foreground: the rest would take most of the time and gets no points.
    left, top, width, height = cv2.boundingRect(mask.astype(np.uint8))
    cropped = mask[top : top + height, left : left + width]
    if not width:
        return np.zeros((count, 2), np.float32)
    rows, columns = np.nonzero(cropped)
    # Neighbours on the curve are neighbours in the image, so equal steps along it leave no gaps, unlike steps along the rows.
    along = np.argsort(_place_on_curve(rows, columns))
    rows, columns = rows[along], columns[along]
    total = np.cumsum(1 / np.maximum(local_thickness(cropped)[rows, columns], 1.0), dtype=float)
    chosen = np.searchsorted(total, total[-1] * (np.arange(count) + 0.5) / count)
    return np.stack([columns[chosen] + left - mask.shape[1] / 2, rows[chosen] + top - mask.shape[0] / 2], axis=1).astype(np.float32)


def _place_on_curve(rows: Int[np.ndarray, " pixel"], columns: Int[np.ndarray, " pixel"]) -> Int[np.ndarray, " pixel"]:
    """The position of each pixel on the curve of Morton (1966), which fills quadrant after quadrant: the interleaved bits of row and column."""
    place = np.zeros_like(rows)
    for bit in range(int(max(rows.max(), columns.max())).bit_length()):
        place |= ((columns >> bit & 1) << 2 * bit) | ((rows >> bit & 1) << 2 * bit + 1)
    return place
