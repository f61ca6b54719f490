"""The part of an image that a picture shows, and where points of the image are in it."""

from typing import NamedTuple

import cv2
import numpy as np
from cv2.typing import MatLike
from jaxtyping import Float

# Room around the points, as a fraction of the longer side of their box; the largest zoom, picture pixels per image pixel.
MARGIN, MOST_ZOOM = 0.25, 3.0


class Crop(NamedTuple):
    """A rectangle of an image, scaled.

    Attributes:
        left: its first column, image pixels.
        top: its first row.
        right: the column after its last.
        bottom: the row after its last.
        scale: picture pixels per image pixel.
    """

    left: int
    top: int
    right: int
    bottom: int
    scale: float

    def cut(self, image: MatLike) -> MatLike:
        """Return the picture."""
        part = image[self.top : self.bottom, self.left : self.right]
        size = max(round(part.shape[1] * self.scale), 1), max(round(part.shape[0] * self.scale), 1)
        return cv2.resize(part, size, interpolation=cv2.INTER_AREA if self.scale < 1 else cv2.INTER_CUBIC)

    def place(self, points: Float[np.ndarray, "*point 2"]) -> Float[np.ndarray, "*point 2"]:
        """Return the positions of image points, (column, row), in the picture. Integers are the centres of pixels, in both."""
        return (points - (self.left, self.top) + 0.5) * self.scale - 0.5


def crop_about(points: Float[np.ndarray, "point 2"], size_px: tuple[int, int], widest: int, most_zoom: float = MOST_ZOOM) -> Crop:
    """Return the part of an image of that size (width, height) that contains the points, with a margin; the whole image if that holds none of them.

    Args:
        points: column and row, pixels.
        size_px: width and height of the image.
        widest: longest side of the picture, pixels.
        most_zoom: the largest zoom, picture pixels per image pixel.
    """
    left, top, (right, bottom) = 0, 0, size_px
    if len(points):
        size, margin = np.array(size_px), MARGIN * np.ptp(points, axis=0).max()
        least = np.clip(points.min(axis=0) - margin, 0, size - 1).astype(int).tolist()
        most = np.clip(points.max(axis=0) + margin, 1, size).astype(int).tolist()
        if most[0] - least[0] > 1 and most[1] - least[1] > 1:
            (left, top), (right, bottom) = least, most
    return Crop(left, top, right, bottom, min(widest / max(right - left, bottom - top), most_zoom))
