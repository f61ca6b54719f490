"""Error maps of silhouettes and edges (Darby, Li & Costen 2008, 6.1), computed on the host while the device works on the previous frame.

By density, as in the paper: the mask, smoothed; and the gradient's magnitude, thresholded, smoothed by a Gaussian and rescaled to [0, 1], "giving
each pixel a measure of proximity to an edge". By distance: V = exp(−d²/2h²) of the distance d to the foreground, and to the nearest edge. With
distances, an arm five pixels wide agrees with its silhouette as fully as a torso does, and a single outline counts as much as a striped shirt
(docs/decisions). Both maps are stored as (1 − V)², which is what the likelihood averages.

What other people cover is not seen: it has a constant error, and neither their silhouettes nor their edges draw anything.

Points are spread over a silhouette so that a limb gets points in proportion to its length. By area, a torso would get most of them, and an arm few.
"""

import math
from collections.abc import Callable, Sequence
from functools import lru_cache
from typing import Any, Literal

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int
from numpy.typing import NDArray

from bayes_body.base.registry import register
from bayes_body.base.toml.schema import NonNegative, Positive, Schema, Share
from bayes_body.recording.evidence.silhouette_edges import UNSEEN_SHARE, Levels, SilhouetteEdgeMaps, hide, pack, quantised
from bayes_body.recording.observation.covered import largest_figure, uncovered
from bayes_body.recording.observation.frames import Frame, covered_of, masks_of


def local_thickness(mask: Bool[np.ndarray, "row column"]) -> Float[np.ndarray, "row column"]:
    """At each pixel: the radius of the largest disc inside the foreground that contains it, pixels (Hildebrand & Rüegsegger 1997); 0 outside."""
    # Add a border of background: a silhouette cut by the image's edge counts as thick as its visible part.
    inside = cv2.distanceTransform(np.pad(mask.astype(np.uint8), 1), cv2.DIST_L2, 5)[1:-1, 1:-1]
    thickness = inside.copy()
    rows, columns = np.nonzero(_uncovered(inside, _ridge(inside)))
    radii = inside[rows, columns]
    # Draw smaller discs first, so that larger ones overwrite them.
    order = np.argsort(radii)
    for column, row, radius in zip(columns[order].tolist(), rows[order].tolist(), radii[order].tolist(), strict=True):
        cv2.circle(thickness, (column, row), int(radius), radius, cv2.FILLED)
    return np.where(mask, thickness, 0).astype(np.float32)


def _ridge(inside: Float[np.ndarray, "row column"]) -> Bool[np.ndarray, "row column"]:
    """Where the distance to the background is no smaller than on both sides, along rows or along columns."""
    wide = np.pad(inside, 1)
    is_ridge_of_row = (inside >= wide[1:-1, :-2]) & (inside >= wide[1:-1, 2:])
    is_ridge_of_column = (inside >= wide[:-2, 1:-1]) & (inside >= wide[2:, 1:-1])
    return (inside > 0) & (is_ridge_of_row | is_ridge_of_column)


def _uncovered(inside: Float[np.ndarray, "row column"], ridge: Bool[np.ndarray, "row column"]) -> Bool[np.ndarray, "row column"]:
    """The pixels of a ridge whose disc is not within that of a neighbour on the ridge: a whole radius more contains it. Most discs are within one."""
    radius = np.pad(np.where(ridge, inside.astype(np.int32), 0), 1)
    largest = np.maximum.reduce([radius[1:-1, :-2], radius[1:-1, 2:], radius[:-2, 1:-1], radius[2:, 1:-1]])
    return ridge & (largest <= radius[1:-1, 1:-1])


def spread_points(mask: Bool[np.ndarray, "row column"], count: int) -> Float[np.ndarray, "point 2"]:
    """`count` pixels of a mask, each for an equal share of area divided by thickness: (point, 2), column and row relative to the image's centre.

    All are 0 if the mask is empty.
    """
    if not count:
        return np.zeros((0, 2), np.float32)
    # Crop to the foreground: the rest would take most of the time and gets no points.
    first_column, first_row, width, height = cv2.boundingRect(mask.astype(np.uint8))
    cropped = mask[first_row : first_row + height, first_column : first_column + width]
    if not width:
        return np.zeros((count, 2), np.float32)
    rows, columns = np.nonzero(cropped)
    # Neighbours on the curve are neighbours in the image, so equal steps along it leave no gaps, unlike steps along the rows.
    order = np.argsort(_place_on_curve(rows, columns))
    rows, columns = rows[order], columns[order]
    total = np.cumsum(1 / np.maximum(local_thickness(cropped)[rows, columns], 1.0), dtype=float)
    chosen = np.searchsorted(total, total[-1] * (np.arange(count) + 0.5) / count)
    return np.stack([columns[chosen] + first_column - mask.shape[1] / 2, rows[chosen] + first_row - mask.shape[0] / 2], axis=1).astype(np.float32)


def _place_on_curve(rows: Int[np.ndarray, " pixel"], columns: Int[np.ndarray, " pixel"]) -> Int[np.ndarray, " pixel"]:
    """The position of each pixel on the curve of Morton (1966), which fills quadrant after quadrant: the interleaved bits of row and column."""
    spread = _spread_bits(1 << int(max(rows.max(), columns.max())).bit_length())
    return spread[columns] | (spread[rows] << 1)


@lru_cache(4)
def _spread_bits(count: int) -> Int[np.ndarray, " number"]:
    """The numbers below a count with a zero in front of each of their bits."""
    numbers, spread = np.arange(count), np.zeros(count, int)
    for bit in range(count.bit_length()):
        spread |= (numbers >> bit & 1) << 2 * bit
    return spread


# At so many standard deviations, closeness rounds to none in a map of 8 bits (OpenCV's distances are up to 5 % short), and OpenCV's Gaussians end.
FARTHEST = 4.0
# A box begins at a multiple of so many columns: OpenCV works on as many at once.
ALIGNED = 16
EVERYWHERE = slice(0, None), slice(0, None)


class Options(Schema):
    """Options of `[likelihood.observation]` of `silhouette_edges`.

    `proximity` chooses how the maps are made. By distance, h is `silhouette_smooth_px` and `edge_smooth_px`; edges count only within
    `edges_within_px` of the silhouette, because the others belong to the room. A sample outside an image counts as the error `unseen_error`, wherever
    it is; 0.5 is half way between full agreement and none. So does every sample in a camera that did not see the frame, or has no silhouette in it.
    A sample that another person covers, on foreground that may be either's, counts as `covered_error`.
    `area_of` says whose foreground counts in the agreement of areas, (9): all of it, or the largest figure's, for views of more than one person.
    """

    proximity: Literal["density", "distance"] = "density"
    """`"density"`, as in the paper: the mask and the edges, smoothed. `"distance"`: the distances to the silhouette and to the nearest edge."""
    silhouette_smooth_px: Positive = 2.0
    """[pixels] standard deviation of the Gaussian that smooths the mask or, with `"distance"`, of the Gaussian with which agreement decreases with
    distance."""
    edge_threshold: Positive = 20.0
    """[grey levels per pixel] gradient above which a pixel is an edge."""
    edge_smooth_px: Positive = 3.0
    """[pixels] standard deviation of the Gaussian that smooths the edges or, with `"distance"`, of the Gaussian with which agreement decreases with
    distance."""
    edges_within_px: NonNegative = 4.0
    """[pixels] with `"distance"`: edges farther from the silhouette belong to the room and do not count."""
    unseen_error: Share = 0.5
    """the error of a sample outside the image, between 0 (full agreement) and 1 (none)."""
    covered_error: Share = 0.25
    """the error of a sample that another person covers, where the silhouette may be either's."""
    area_of: Literal["all", "largest"] = "all"
    """whose foreground counts in the agreement of areas: `"all"` of it, or that of the `"largest"` figure, where more than one person is in view."""


def edge_proximity(grey: NDArray[np.uint8], threshold: float, smooth_px: float, covered: NDArray[np.bool_] | None = None) -> NDArray[np.float32]:
    """Closeness to an edge, in [0, 1]: 1 where edges are densest; zero everywhere in an image without edges.

    Args:
        grey: image (row, column).
        threshold: grey levels per pixel that the gradient must exceed.
        smooth_px: standard deviation of the Gaussian.
        covered: where other people's edges are (row, column), which do not count.
    """
    proximity = cv2.GaussianBlur(uncovered(edges(grey, threshold), covered).astype(np.float32), (0, 0), smooth_px)
    highest = float(proximity.max())
    return np.asarray(proximity / highest if highest > 0 else proximity, np.float32)


def edges(grey: NDArray[np.uint8], threshold: float) -> NDArray[np.bool_]:
    """Where the gradient of an image (row, column) exceeds `threshold`, grey levels per pixel: (row, column)."""
    # On a ramp of one level per pixel, Sobel's mask gives 8.
    return cv2.magnitude(cv2.Sobel(grey, cv2.CV_32F, 1, 0), cv2.Sobel(grey, cv2.CV_32F, 0, 1)) > 8 * threshold


def smooth_silhouette(mask: NDArray[np.bool_], smooth_px: float, covered: NDArray[np.bool_] | None = None) -> NDArray[np.float32]:
    """The mask (row, column), smoothed by a Gaussian: in [0, 1]. Of what others cover, it is smoothed over the rest only."""
    smooth = np.asarray(cv2.GaussianBlur(mask.astype(np.float32), (0, 0), smooth_px), np.float32)
    if covered is None:
        return smooth
    weight = cv2.GaussianBlur((~covered).astype(np.float32), (0, 0), smooth_px)
    return np.minimum(smooth / np.maximum(weight, np.float32(1e-6)), 1)


def distance_to(marked: NDArray[np.bool_]) -> NDArray[np.float32]:
    """Distance from each pixel (row, column) to the nearest marked one, pixels; rows + columns if none is marked."""
    distance = cv2.distanceTransform((~marked).astype(np.uint8), cv2.DIST_L2, 5)
    return np.minimum(distance, np.float32(sum(marked.shape)))


def closeness(distance: NDArray[np.float32], scale_px: float) -> NDArray[np.float32]:
    """exp(−d²/2h²) of a distance d and the scale h, both in pixels: in [0, 1], with the distance's shape."""
    return np.exp(-0.5 * (distance / scale_px) ** 2)


def surroundings(mask: NDArray[np.bool_], reach_px: float) -> tuple[slice, slice]:
    """Rows and columns of a mask's (row, column) smallest box, enlarged by `reach_px` on all sides; everything if the mask is empty."""
    first_column, first_row, columns, rows = cv2.boundingRect(mask.view(np.uint8))
    if not rows:
        return EVERYWHERE
    # Filters and approximate distances need two more pixels.
    margin = math.ceil(reach_px) + 2
    start, stop = max(first_column - margin, 0) // ALIGNED * ALIGNED, first_column + columns + margin
    return slice(max(first_row - margin, 0), first_row + rows + margin), slice(start, -(-stop // ALIGNED) * ALIGNED)


def _uncovered_cells(covered: Sequence[NDArray[np.bool_] | None], columns: int, rows: int) -> Float[np.ndarray, "camera row column"]:
    """The fraction of each cell of a grid over the images that other people do not cover."""
    cells = [
        np.ones((rows, columns), np.float32)
        if region is None
        else cv2.resize((~region).astype(np.float32), (columns, rows), interpolation=cv2.INTER_AREA)
        for region in covered
    ]
    return np.stack(cells)


@register("observation", "silhouette_edges", Options)
def build(options: Options, likelihood: Any = None, **_: Any) -> Callable[[Frame], SilhouetteEdgeMaps]:
    """Compute the likelihood's maps from a frame's images and masks.

    Args:
        options: options of the maps.
        likelihood: the options of the likelihood that reads them. If it has the term "cover", its `cover_points` are used.
    """
    count = likelihood.cover_points if "cover" in getattr(likelihood, "terms", ()) else 0
    area_grid = likelihood.area_grid if getattr(likelihood, "gamma", 0) else None

    def by_density(image: NDArray[np.uint8], mask: NDArray[np.bool_], covered: NDArray[np.bool_] | None, shape: tuple[int, int]) -> Levels:
        # A smoothed silhouette is 0 beyond the filter's reach.
        box = surroundings(mask, FARTHEST * options.silhouette_smooth_px)
        silhouette = smooth_silhouette(mask[box], options.silhouette_smooth_px, None if covered is None else covered[box])
        edge_values = edge_proximity(image, options.edge_threshold, options.edge_smooth_px, covered)
        return np.stack([levels_in(box, silhouette, image.shape, shape), levels_in(EVERYWHERE, edge_values, image.shape, shape)])

    def by_distance(image: NDArray[np.uint8], mask: NDArray[np.bool_], covered: NDArray[np.bool_] | None, shape: tuple[int, int]) -> Levels:
        box = surroundings(mask, FARTHEST * max(options.silhouette_smooth_px, options.edge_smooth_px) + options.edges_within_px)
        outside = distance_to(mask[box])
        edge_pixels = edges(image[box], options.edge_threshold) & (outside <= options.edges_within_px)
        edge_pixels = uncovered(edge_pixels, None if covered is None else covered[box])
        values = closeness(outside, options.silhouette_smooth_px), closeness(distance_to(edge_pixels), options.edge_smooth_px)
        return np.stack([levels_in(box, value, image.shape, shape) for value in values])

    def levels_in(box: tuple[slice, slice], values: NDArray[np.float32], size: tuple[int, ...], shape: tuple[int, int]) -> Levels:
        errors = 1 - values
        errors *= errors
        return quantised(errors, options.unseen_error, shape, (box[0].start, box[1].start), size)

    maps_of = by_distance if options.proximity == "distance" else by_density

    def observe(frame: Frame) -> SilhouetteEdgeMaps:
        unseen = quantised(np.empty((0, 0), np.float32), options.unseen_error, frame.largest)
        stacks, shares, points = [], [], []
        for image, figures, covered in zip(frame.images, masks_of(frame), covered_of(frame), strict=True):
            if image is None or figures is None or (covered is not None and covered.all()):
                stacks.append(np.stack([unseen, unseen]))
                shares.append(UNSEEN_SHARE)
                points.append(np.zeros((count, 2), np.float32))
            else:
                mask = uncovered(figures, covered)
                stacks.append(hide(maps_of(image, mask, covered, frame.largest), covered, options.covered_error))
                area = mask.size if covered is None else mask.size - np.count_nonzero(covered)
                shares.append(np.count_nonzero(largest_figure(mask) if options.area_of == "largest" else mask) / area)
                points.append(spread_points(mask, count))
        cells = None if area_grid is None or frame.covered is None else _uncovered_cells(frame.covered, *area_grid)
        return SilhouetteEdgeMaps(pack(np.stack(stacks)), np.array(shares, np.float32), np.stack(points), cells)

    return observe
