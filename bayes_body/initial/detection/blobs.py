"""Elongated colour blobs inside the foreground of one view: mean-shift segmentation (Comaniciu & Meer 2002) and ellipses of the segments."""

from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Float

from bayes_body.initial.detection.hull import Mask
from bayes_body.recording.observation.pictures import Colours

# The person's picture is brought to this height before the segmentation, pixels.
HEIGHT_PX = 220
# Radii of the mean shift in space (pixels) and colour, and the step of colour at which a segment ends, grey levels.
SPACE_PX, COLOUR, EDGE = 6, 18, 14
# Pyramid levels of the mean shift above the picture.
LEVELS = 0
# Least area of a blob, share of the foreground; largest, and the least ratio of its axes.
AREA, ELONGATED = (0.004, 0.35), 1.25

# Segments of at least so many pixels are cut in two as well.
HALVED_PX = 300


class Blob(NamedTuple):
    """An ellipse in the camera's image, pixels: its middle, the two ends of its long axis, half of its short axis, and the mean colour (b, g, r)."""

    middle: Float[np.ndarray, "2"]
    ends: Float[np.ndarray, "2 2"]
    radius: float
    colour: Float[np.ndarray, "3"]


def blobs(picture: Colours, mask: Mask) -> list[Blob]:
    """The blobs of one view, the largest first; none without foreground."""
    left, top, width, height = cv2.boundingRect(mask.astype(np.uint8))
    if width < 2 or height < 2:
        return []
    scale = HEIGHT_PX / max(width, height)
    size = max(1, round(width * scale)), max(1, round(height * scale))
    cut = slice(top, top + height), slice(left, left + width)
    small = cv2.resize(picture[cut], size, interpolation=cv2.INTER_AREA if scale < 1 else cv2.INTER_LINEAR)
    inside = cv2.resize(mask[cut].astype(np.uint8), size, interpolation=cv2.INTER_NEAREST) > 0
    smooth = cv2.pyrMeanShiftFiltering(small, SPACE_PX, COLOUR, maxLevel=LEVELS)
    segments = _segments(np.asarray(smooth, np.uint8), inside)
    candidates = [_blob(smooth, piece) for segment in segments for piece in (segment, *_halves(segment))]
    # Pixels' centres: (u + 1/2) of the small picture is scale (u + 1/2) of the large one.
    offset = np.array([left, top]) - 0.5 + 0.5 / scale
    return [Blob(b.middle / scale + offset, b.ends / scale + offset, b.radius / scale, b.colour) for b in candidates if _is_elongated(b)]


def _segments(smooth: Colours, inside: Mask) -> list[Mask]:
    """Connected pixels of the foreground between which the colour changes slowly, the largest first."""
    steps = cv2.morphologyEx(smooth, cv2.MORPH_GRADIENT, np.ones((2, 2), np.uint8)).max(axis=2)
    count, labels, stats, _ = cv2.connectedComponentsWithStats((inside & (steps < EDGE)).astype(np.uint8), connectivity=4)
    areas = stats[:, cv2.CC_STAT_AREA] / max(int(inside.sum()), 1)
    segment_labels = [k for k in range(1, count) if AREA[0] <= areas[k] <= AREA[1]]
    return [labels == k for k in sorted(segment_labels, key=lambda k: -areas[k])]


def _halves(segment: Mask) -> list[Mask]:
    """The two halves of a segment, cut across its long axis: a sleeve or a trouser leg may be one segment with two parts."""
    rows, columns = np.nonzero(segment)
    if len(rows) < HALVED_PX:
        return []
    offsets = np.stack([columns, rows], axis=1) - (columns.mean(), rows.mean())
    along = offsets @ np.linalg.eigh(offsets.T @ offsets)[1][:, 1]
    pieces = [np.zeros_like(segment), np.zeros_like(segment)]
    for piece, chosen in zip(pieces, (along < 0, along >= 0), strict=True):
        piece[rows[chosen], columns[chosen]] = True
    return pieces


def _blob(smooth: Colours, segment: Mask) -> Blob:
    rows, columns = np.nonzero(segment)
    points = np.stack([columns, rows], axis=1).astype(float)
    middle = points.mean(axis=0)
    spread, axes = np.linalg.eigh(np.cov((points - middle).T) if len(points) > 2 else np.eye(2))
    # An ellipse with half axes a and b has the variances a^2 / 4 and b^2 / 4.
    half, radius = 2 * np.sqrt(np.maximum(spread[1], 0.1)), 2 * np.sqrt(np.maximum(spread[0], 0.1))
    return Blob(middle, middle + np.array([[-half], [half]]) * axes[:, 1], float(radius), smooth[segment].mean(axis=0).astype(float))


def _is_elongated(blob: Blob) -> bool:
    return float(np.linalg.norm(blob.ends[1] - blob.ends[0])) >= 2 * ELONGATED * blob.radius
