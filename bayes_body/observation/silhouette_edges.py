"""Error maps of silhouettes and edges (Darby, Li & Costen 2008, 6.1): prepared on the host while the device works on the frame before.

Silhouette: the mask, smoothed. Edges: the gradient's magnitude, thresholded, smoothed by a Gaussian, rescaled to [0, 1], "giving each pixel a
measure of proximity to an edge". Both are stored as (1 − V)², which is what the likelihood averages.
"""

from collections.abc import Callable
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from bayes_body.errors import wrong
from bayes_body.maps import UNSEEN_SHARE, SilhouetteEdgeMaps, pack
from bayes_body.observation.frames import Frame
from bayes_body.registry import register
from bayes_body.schema import Positive, Schema, Share


class Options(Schema):
    """Options of `[likelihood.observation]` of `silhouette_edges`.

    A sample outside an image says nothing: it counts `unseen_error`, wherever it is; 0.5 lies half way between full agreement and none. So does every
    sample in a camera that did not see the frame, or whose silhouette is not to be had.
    """

    silhouette_smooth_px: Positive = 2.0
    edge_threshold: Positive = 20.0
    edge_smooth_px: Positive = 3.0
    unseen_error: Share = 0.5


def edge_proximity(grey: NDArray[np.uint8], threshold: float, smooth_px: float) -> NDArray[np.float32]:
    """Closeness to an edge, in [0, 1], 1 where edges are densest; zero everywhere in an image without any.

    Args:
        grey: image (row, column).
        threshold: grey levels a pixel that the gradient must exceed.
        smooth_px: standard deviation of the Gaussian.
    """
    # Sobel's mask sums to 8 on a ramp of one level a pixel.
    magnitude = cv2.magnitude(cv2.Sobel(grey, cv2.CV_32F, 1, 0), cv2.Sobel(grey, cv2.CV_32F, 0, 1)) / 8
    proximity = cv2.GaussianBlur((magnitude > threshold).astype(np.float32), (0, 0), smooth_px)
    highest = float(proximity.max())
    return np.asarray(proximity / highest if highest > 0 else proximity, np.float32)


def smooth_silhouette(mask: NDArray[np.bool_], smooth_px: float) -> NDArray[np.float32]:
    """The mask (row, column), smoothed by a Gaussian: in [0, 1]."""
    return np.asarray(cv2.GaussianBlur(mask.astype(np.float32), (0, 0), smooth_px), np.float32)


def foreground_points(mask: NDArray[np.bool_], count: int) -> NDArray[np.float32]:
    """So many pixels of a mask, evenly spaced among its foreground row by row: (point, 2), column and row from the image's middle on.

    All are 0 of an empty mask.
    """
    found = np.flatnonzero(mask)
    if not found.size:
        return np.zeros((count, 2), np.float32)
    row, column = np.divmod(found[(2 * np.arange(count) + 1) * found.size // (2 * count)], mask.shape[1])
    return np.stack([column - mask.shape[1] / 2, row - mask.shape[0] / 2], axis=1).astype(np.float32)


@register("observation", "silhouette_edges", Options)
def build(options: Options, likelihood: Any = None, **_: Any) -> Callable[[Frame], SilhouetteEdgeMaps]:
    """From a frame's images and masks to the likelihood's maps, as NumPy arrays.

    Args:
        options: of the maps.
        likelihood: the options of the likelihood that reads them: whether it has the term "cover", and its `cover_points`.
    """
    count = likelihood.cover_points if "cover" in getattr(likelihood, "terms", ()) else 0

    def maps_of(image: NDArray[np.uint8], mask: NDArray[np.bool_], shape: tuple[int, int]) -> NDArray[np.uint32]:
        silhouette = smooth_silhouette(mask, options.silhouette_smooth_px)
        edges = edge_proximity(image, options.edge_threshold, options.edge_smooth_px)
        return np.stack([pack((1 - value) ** 2, options.unseen_error, shape) for value in (silhouette, edges)])

    def observe(frame: Frame) -> SilhouetteEdgeMaps:
        if frame.masks is None:
            expected = "a silhouette for every image"
            remedy = "give each [[camera]] its `masks`, or an image of the empty scene as `background`"
            raise wrong("session.toml", "its cameras have no masks, and the frames are too few to learn the background from", expected, remedy)
        unseen = pack(np.empty((0, 0), np.float32), options.unseen_error, frame.largest)
        stacks, shares, points = [], [], []
        for image, mask in zip(frame.images, frame.masks, strict=True):
            if image is None or mask is None:
                stacks.append(np.stack([unseen, unseen]))
                shares.append(UNSEEN_SHARE)
                points.append(np.zeros((count, 2), np.float32))
            else:
                stacks.append(maps_of(image, mask, frame.largest))
                shares.append(mask.mean())
                points.append(foreground_points(mask, count))
        return SilhouetteEdgeMaps(np.stack(stacks), np.array(shares, np.float32), np.stack(points))

    return observe
