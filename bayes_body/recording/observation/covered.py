"""The region of an image that other people cover: from their keypoints, or from where the subject was.

What another person covers counts as not seen, whoever is in front: where two silhouettes are one, nobody can tell whose a pixel is. A person is
drawn as capsules between keypoints, with widths in proportion to the person's size in the image. A capsule is drawn only if both of its keypoints are
there. The widths are those of dressed people, and a little generous: what is hidden in vain is only a loss, but a bystander's outline pulls. Where
the silhouette is background, nobody is, and nothing is hidden.
"""

from collections.abc import Mapping, Sequence

import cv2
import numpy as np
from jaxtyping import Bool, Float
from numpy.typing import NDArray

# Less certain keypoints are guesses of the network: they would cover what nobody does.
LEAST_CONFIDENCE = 0.2


def _both_sides(shares: Mapping[tuple[str, str], float]) -> dict[tuple[str, str], float]:
    return {(f"{side}_{start}", f"{side}_{end}"): share for side in "lr" for (start, end), share in shares.items()}


# The lengths of segments in the world, as shares of stature (Drillis & Contini 1966, between joint centres).
LENGTHS = {
    **_both_sides({("hip", "knee"): 0.245, ("knee", "ankle"): 0.246, ("shoulder", "elbow"): 0.186, ("elbow", "wrist"): 0.146}),
    **_both_sides({("shoulder", "hip"): 0.288}),
    ("thorax", "pelvis"): 0.29,
}
# Segments look shorter than they are, if they point at the camera: the size is that of which so many look larger.
LONGEST = 0.75
# Radii of capsules, as shares of stature.
RADII = {
    **_both_sides({("hip", "knee"): 0.07, ("knee", "ankle"): 0.055, ("ankle", "big_toe"): 0.045, ("ankle", "heel"): 0.045}),
    **_both_sides({("shoulder", "elbow"): 0.05, ("elbow", "wrist"): 0.045, ("shoulder", "hip"): 0.08}),
    ("l_shoulder", "r_hip"): 0.08,
    ("r_shoulder", "l_hip"): 0.08,
    ("l_shoulder", "r_shoulder"): 0.07,
    ("l_hip", "r_hip"): 0.09,
    ("thorax", "pelvis"): 0.1,
    ("thorax", "head"): 0.075,
    ("thorax", "nose"): 0.085,
    ("nose", "l_ear"): 0.085,
    ("nose", "r_ear"): 0.085,
}
# Beyond the wrist a hand continues the forearm by this share of it. A foot of which no toe is there points anywhere: it lies in a disc.
HAND, FOOT_RADIUS = 0.75, 0.1
# Pieces of a figure are at most this share of the image's longer side apart.
GAP = 0.01
# A figure of less than this share of the largest one, and beside a covered region, is what the region has missed.
REMNANT = 0.04
# What a body does not explain is farther from it than this share of the root of its area, about 10 cm: clothes, hair and the way to the next frame
# are nearer. It has at least this share of the body's area: a leg has less. The body must lie on the silhouette by this share.
FAR, LEAST_FIGURE, ON_FIGURE = 0.15, 0.2, 0.5
# Farther outside of an image, in sides of it, nothing is drawn.
FARTHEST = 4

type Mask = Bool[np.ndarray, "row column"]
type Point = Float[np.ndarray, "2"]


def covered_by(people: Sequence[Mapping[str, Sequence[float]]], size_px: tuple[int, int]) -> Mask | None:
    """Return where people cover an image, (row, column); None if there are no people.

    Args:
        people: for each person: column, row (pixels) and confidence of keypoints, by marker or by name of the detector.
        size_px: (width, height) of the image.
    """
    if not people:
        return None
    region = np.zeros(size_px[::-1], np.uint8)
    for keypoints in people:
        _draw(region, _points(keypoints, size_px))
    return region.view(np.bool_)


def uncovered(mask: NDArray[np.bool_], covered: NDArray[np.bool_] | None) -> NDArray[np.bool_]:
    """Return the part of a mask (row, column) that nobody covers."""
    return mask if covered is None else mask & ~covered


def largest_figure(mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return the largest connected part of a mask (row, column), with the pieces that a narrow gap separates from it."""
    reach = _gap_px(mask)
    joined = cv2.dilate(mask.astype(np.uint8), np.ones((reach, reach), np.uint8))
    labels = np.asarray(cv2.connectedComponents(joined)[1], np.int32)
    sizes = np.bincount(labels[mask], minlength=1)
    return mask & (labels == sizes.argmax())


def beside_body(mask: NDArray[np.bool_], body: NDArray[np.bool_]) -> Mask | None:
    """Return the region of a silhouette that a body does not explain, and what is as near to it as to the body, (row, column); None if all is.

    What is far from the body and large is another figure's, whether it stands apart or touches the subject's. Smaller pieces may be an arm that the
    body has lost. Where the body is not on the silhouette, nobody can tell whose it is, and all of it is seen.

    Args:
        mask: the silhouette.
        body: the projection of the body near to where it is now, such as that of the frame before.
    """
    area = np.count_nonzero(body)
    if not area or np.count_nonzero(mask & body) < ON_FIGURE * area:
        return None
    reach = FAR * np.sqrt(area)
    unexplained = mask & ~_within(body, reach)
    labels = np.asarray(cv2.connectedComponents(unexplained.astype(np.uint8))[1], np.int32)
    is_other = np.bincount(labels[unexplained], minlength=1) >= LEAST_FIGURE * area
    figures = unexplained & is_other[labels]
    return _widened(mask) & _within(figures, reach + _gap_px(mask)) if figures.any() else None


def ambiguous(mask: NDArray[np.bool_], region: NDArray[np.bool_]) -> Mask:
    """Return the part of a region that other people cover in which a silhouette can be theirs, (row, column).

    What is background in the silhouette shows nobody, so it is seen; but for a narrow margin, because outlines are blurred. Small figures that begin
    at the region belong to it: tips of shoes, hair and clothes. A hand of the subject's that someone else cuts off is among them, which is a loss.
    """
    hidden = region & _widened(mask)
    visible = mask & ~hidden
    labels = np.asarray(cv2.connectedComponents(visible.astype(np.uint8))[1], np.int32)
    sizes = np.bincount(labels[visible], minlength=1)
    touches = np.bincount(labels[visible & _widened(hidden)], minlength=len(sizes)) > 0
    remnants = visible & (touches & (sizes < REMNANT * sizes.max()))[labels]
    return hidden | (_widened(remnants) & ~(visible & ~remnants))


def _widened(mask: NDArray[np.bool_]) -> Mask:
    side = 2 * _gap_px(mask) + 1
    return np.asarray(cv2.dilate(mask.astype(np.uint8), np.ones((side, side), np.uint8)), np.uint8).view(np.bool_)


def _within(mask: NDArray[np.bool_], reach_px: float) -> Mask:
    """Where a mask that is not empty is at most so far away."""
    return np.asarray(cv2.distanceTransform((~mask).astype(np.uint8), cv2.DIST_L2, 5) <= reach_px, np.bool_)


def _gap_px(mask: NDArray[np.bool_]) -> int:
    return max(1, round(GAP * max(mask.shape)))


def _points(keypoints: Mapping[str, Sequence[float]], size_px: tuple[int, int]) -> dict[str, Point]:
    """Return the pixels of the keypoints that can be used, and of the middles of shoulders and hips."""
    farthest = FARTHEST * max(size_px)
    points = {name: np.array(point[:2], float) for name, point in keypoints.items() if point[2] >= LEAST_CONFIDENCE}
    points = {name: point for name, point in points.items() if np.isfinite(point).all() and np.abs(point).max() <= farthest}
    for middle, joint in (("thorax", "shoulder"), ("pelvis", "hip")):
        if middle not in points and f"l_{joint}" in points and f"r_{joint}" in points:
            points[middle] = (points[f"l_{joint}"] + points[f"r_{joint}"]) / 2
    return points


def _stature_px(points: Mapping[str, Point]) -> float:
    """Return how tall a person would be in the image, upright at this distance, in pixels; 0 if no segment is there."""
    sizes = [np.linalg.norm(points[a] - points[b]) / share for (a, b), share in LENGTHS.items() if a in points and b in points]
    return float(np.quantile(sizes, LONGEST)) if sizes else 0.0


def _draw(region: NDArray[np.uint8], points: Mapping[str, Point]) -> None:
    stature = min(_stature_px(points), FARTHEST * max(region.shape))
    if not stature:
        return
    for (start, end), share in RADII.items():
        if start in points and end in points:
            _capsule(region, points[start], points[end], share * stature)
    for side in "lr":
        elbow, wrist, ankle = (points.get(f"{side}_{joint}") for joint in ("elbow", "wrist", "ankle"))
        if elbow is not None and wrist is not None:
            _capsule(region, wrist, wrist + HAND * (wrist - elbow), RADII[f"{side}_elbow", f"{side}_wrist"] * stature)
        if ankle is not None and f"{side}_big_toe" not in points:
            _capsule(region, ankle, ankle, FOOT_RADIUS * stature)


def _capsule(region: NDArray[np.uint8], start: Point, end: Point, radius_px: float) -> None:
    # OpenCV's thick lines have round ends.
    first, last = ([round(float(value)) for value in point] for point in (start, end))
    cv2.line(region, first, last, (1.0,), max(1, min(round(2 * radius_px), 2 * max(region.shape))))
