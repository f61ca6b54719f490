"""Points of a silhouette, as many on a limb as its length deserves: by area a torso would get most of them, and an arm next to none."""

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int


def local_thickness(mask: Bool[np.ndarray, "row column"]) -> Float[np.ndarray, "row column"]:
    """At each pixel the radius of the largest disc in the foreground that holds the pixel, pixels (Hildebrand & Rüegsegger 1997); 0 outside."""
    # With a border of background: a silhouette that an image's edge cuts off is as thick as it is seen to be.
    inside = cv2.distanceTransform(np.pad(mask.astype(np.uint8), 1), cv2.DIST_L2, 5)[1:-1, 1:-1]
    thickness = inside.copy()
    rows, columns = np.nonzero(_ridge(inside))
    radii = inside[rows, columns]
    for k in np.argsort(radii):
        # Smaller discs first: a larger one is drawn over them.
        cv2.circle(thickness, (int(columns[k]), int(rows[k])), int(radii[k]), float(radii[k]), cv2.FILLED)
    return np.where(mask, thickness, 0).astype(np.float32)


def _ridge(inside: Float[np.ndarray, "row column"]) -> Bool[np.ndarray, "row column"]:
    """Where the distance to the background is no smaller than on both sides, along rows or columns."""
    wide = np.pad(inside, 1)
    across = (inside >= wide[1:-1, :-2]) & (inside >= wide[1:-1, 2:])
    upright = (inside >= wide[:-2, 1:-1]) & (inside >= wide[2:, 1:-1])
    return (inside > 0) & (across | upright)


def spread_points(mask: Bool[np.ndarray, "row column"], count: int) -> Float[np.ndarray, "point 2"]:
    """So many pixels of a mask, each for the same share of area divided by thickness: (point, 2), column and row from the image's middle on.

    All are 0 of an empty mask.
    """
    if not count:
        return np.zeros((0, 2), np.float32)
    # What lies around the foreground takes most of the time, and none of the points.
    left, top, width, height = cv2.boundingRect(mask.astype(np.uint8))
    found = mask[top : top + height, left : left + width]
    if not width:
        return np.zeros((count, 2), np.float32)
    rows, columns = np.nonzero(found)
    # What follows one another on the curve lies together, so equal steps along it leave no gaps, as steps along the rows would.
    along = np.argsort(_place_on_curve(rows, columns))
    rows, columns = rows[along], columns[along]
    total = np.cumsum(1 / np.maximum(local_thickness(found)[rows, columns], 1.0), dtype=float)
    chosen = np.searchsorted(total, total[-1] * (np.arange(count) + 0.5) / count)
    return np.stack([columns[chosen] + left - mask.shape[1] / 2, rows[chosen] + top - mask.shape[0] / 2], axis=1).astype(np.float32)


def _place_on_curve(rows: Int[np.ndarray, " pixel"], columns: Int[np.ndarray, " pixel"]) -> Int[np.ndarray, " pixel"]:
    """Of each pixel on the curve of Morton (1966), which fills quadrant after quadrant: the bits of row and column in turn."""
    place = np.zeros_like(rows)
    for bit in range(int(max(rows.max(), columns.max())).bit_length()):
        place |= ((columns >> bit & 1) << 2 * bit) | ((rows >> bit & 1) << 2 * bit + 1)
    return place
