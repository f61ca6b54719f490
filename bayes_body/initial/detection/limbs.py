r"""The outermost parts, from colour blobs in pairs of views (Sigal, Isard, Haussecker & Black 2011, 6.2).

Blobs are elongated segments of similar colour inside the foreground of one view, described by ellipses (mean-shift segmentation, Comaniciu & Meer
2002). A limb is assumed to have about one colour. Its middle is where the rays through the blobs' middles meet; its axis is the line in which the
planes through the two cameras and the blobs' long axes intersect. Limbs of an impossible size, or outside the foreground, are dropped. All outermost
parts get the same limbs, weighted by the height above the floor (their equation 13), $w_n \propto \mathcal N(z_n; z_\text{part},
\sigma_\text{part}^2)$, and likewise by tilt and length; and by the number of pairs of views that agree. The twist about the axis is unknown.
"""

from collections.abc import Mapping, Sequence
from itertools import combinations
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Bool, Float

from bayes_body.initial.detection.detections import Detections, Found, landmark, segments, strongest
from bayes_body.initial.detection.hull import Mask, rays, triangulate_pair
from bayes_body.initial.detection.scene import Scene
from bayes_body.recording.observation.pictures import Colours
from bayes_body.recording.session.session import CameraSpec

# The person's picture is brought to this height before the segmentation, pixels.
HEIGHT_PX = 220
# Radii of the mean shift in space (pixels) and colour, and the step of colour at which a segment ends, grey levels.
SPACE_PX, COLOUR, EDGE = 6, 18, 14
# Pyramid levels of the mean shift above the picture.
LEVELS = 0
# Least and largest area of a blob, as shares of the foreground, and the least ratio of its axes.
AREA, ELONGATED = (0.004, 0.35), 1.25

# Segments of at least this many pixels are also cut in two.
HALVED_PX = 300


class Blob(NamedTuple):
    """An ellipse in the camera's image, pixels: its middle, the two ends of its long axis, half of its short axis, and the mean colour (b, g, r)."""

    middle: Float[np.ndarray, "2"]
    ends: Float[np.ndarray, "2 2"]
    radius: float
    colour: Float[np.ndarray, "3"]


def blobs(picture: Colours, mask: Mask) -> list[Blob]:
    """Return the blobs of one view, the largest first; none without foreground."""
    first_column, top, width, height = cv2.boundingRect(mask.astype(np.uint8))
    if width < 2 or height < 2:
        return []
    scale = HEIGHT_PX / max(width, height)
    size = max(1, round(width * scale)), max(1, round(height * scale))
    cut = slice(top, top + height), slice(first_column, first_column + width)
    small = cv2.resize(picture[cut], size, interpolation=cv2.INTER_AREA if scale < 1 else cv2.INTER_LINEAR)
    inside = cv2.resize(mask[cut].astype(np.uint8), size, interpolation=cv2.INTER_NEAREST) > 0
    smooth = cv2.pyrMeanShiftFiltering(small, SPACE_PX, COLOUR, maxLevel=LEVELS)
    segments = _segments(np.asarray(smooth, np.uint8), inside)
    candidates = [_blob(smooth, piece) for segment in segments for piece in (segment, *_halves(segment))]
    # Pixels' centres: (u + 1/2) of the small picture is scale (u + 1/2) of the large one.
    offset = np.array([first_column, top]) - 0.5 + 0.5 / scale
    return [Blob(b.middle / scale + offset, b.ends / scale + offset, b.radius / scale, b.colour) for b in candidates if _is_elongated(b)]


def _segments(smooth: Colours, inside: Mask) -> list[Mask]:
    """Return connected pixels of the foreground between which the colour changes slowly, the largest first."""
    steps = cv2.morphologyEx(smooth, cv2.MORPH_GRADIENT, np.ones((2, 2), np.uint8)).max(axis=2)
    count, labels, stats, _ = cv2.connectedComponentsWithStats((inside & (steps < EDGE)).astype(np.uint8), connectivity=4)
    areas = stats[:, cv2.CC_STAT_AREA] / max(int(inside.sum()), 1)
    segment_labels = [k for k in range(1, count) if AREA[0] <= areas[k] <= AREA[1]]
    return [labels == k for k in sorted(segment_labels, key=lambda k: -areas[k])]


def _halves(segment: Mask) -> list[Mask]:
    """Return the halves of a segment, cut across its long axis: a sleeve or a trouser leg may be one segment that covers two parts."""
    rows, columns = np.nonzero(segment)
    if len(rows) < HALVED_PX:
        return []
    offsets = np.stack([columns, rows], axis=1) - (columns.mean(), rows.mean())
    lengthwise = offsets @ np.linalg.eigh(offsets.T @ offsets)[1][:, 1]
    pieces = [np.zeros_like(segment), np.zeros_like(segment)]
    for piece, chosen in zip(pieces, (lengthwise < 0, lengthwise >= 0), strict=True):
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


NAME = "limbs"
# For each part: the height of its middle, the standard deviation of this height, and its length, as fractions of the stature; and whether it hangs
# in most poses.
PARTS: Mapping[str, tuple[float, float, float, bool]] = {
    "forearm": (0.55, 0.08, 0.146, True),
    "hand": (0.45, 0.10, 0.095, True),
    "calf": (0.17, 0.06, 0.246, True),
    "foot": (0.03, 0.03, 0.152, False),
}
# The joint at a part's proximal end.
PROXIMAL = {"forearm": "elbow", "hand": "wrist", "calf": "knee", "foot": "ankle"}
# Accepted ratio of a limb's length to the part's (the ellipse of a forearm with its hand is 1.9 times as long), and radii in metres.
LENGTHS, RADII_M = (0.5, 2.1), (0.015, 0.10)
# Rays may miss each other by this share of the blobs' short half axis and a pixel count; a limb's middle is foreground in this share of the views.
MISS, MISS_PX, FOREGROUND = 0.7, 2.0, 0.7
# A limb's middle lies no deeper inside the visual hull than this, metres.
DEEPEST_M = 0.12
# Limbs nearer to the crown than this are parts of the head, metres.
HEAD_M = 0.3
# Largest distance of the colours of two blobs of one limb, grey levels of a channel; grey cameras are not compared with colour cameras.
COLOURS = 40.0
# Limbs nearer than this and more parallel than this (cosine) are the same; spread of a limb's length about the part's, as a logarithm.
SAME_M, PARALLEL, SD_LOG_LENGTH = 0.06, 0.85, 0.6
# Limbs of less than this share of the largest weight are dropped.
LEAST_WEIGHT = 0.01
# Limbs that are kept for each part; the stature where it is not known.
MOST, STATURE_M = 24, 1.7
SD_ACROSS_M, SD_ALONG_M = 0.04, 0.08
# Spread of the tilt about the one in most poses, radians.
SD_POSE_RAD = 0.6


class Limbs(NamedTuple):
    """Limbs in the world, metres: their middles, lower and upper ends, and radii."""

    middles: Float[np.ndarray, "limb 3"]
    lower: Float[np.ndarray, "limb 3"]
    upper: Float[np.ndarray, "limb 3"]
    radii: Float[np.ndarray, " limb"]


def detect_limbs(scene: Scene) -> Found:
    """Return detections of forearms, hands, calves and feet, and of the landmarks at their proximal ends."""
    masks = scene.people
    if masks is None or len(scene.cameras) < 2:
        return Found({}, {}, ("limbs need silhouettes in two or more cameras",))
    blobs_by_view = [blobs(picture, mask) for picture, mask in zip(scene.pictures, masks, strict=True)]
    limbs = _all_limbs(scene, blobs_by_view)
    if not len(limbs.middles):
        return Found({}, {}, ("no limb was found in any pair of views",))
    stature = scene.stature_m or (STATURE_M if scene.figure is None else scene.figure.height)
    floor = 0.0 if scene.figure is None else scene.figure.floor
    landmarks, parts = {}, {}
    for name in PARTS:
        detections, proximal = _of_part(scene, limbs, name, stature, floor)
        if len(detections.weights):
            for side in ("l_", "r_"):
                parts[side + name], landmarks[side + PROXIMAL[name]] = detections, proximal
    return Found(landmarks, parts)


def _of_part(scene: Scene, limbs: Limbs, name: str, stature: float, floor: float) -> tuple[Detections, Detections]:
    """Return the detections of a part and of the joint at its proximal end, weighted by height."""
    height, sd, length, hangs = PARTS[name]
    axes = limbs.lower - limbs.upper
    lengths = np.linalg.norm(axes, axis=1)
    tilts = np.arccos(np.clip(-axes[:, scene.up] / lengths, -1.0, 1.0))
    z_scores = ((limbs.middles[:, scene.up] - floor) / stature - height) / sd, (tilts if hangs else np.pi / 2 - tilts) / SD_POSE_RAD
    # Beyond three standard deviations the penalty of a height or a tilt is constant, since arms may be raised.
    log_weights = sum(-0.5 * np.minimum(np.abs(z), 3.0) ** 2 for z in z_scores)
    lengths = lengths / (length * stature)
    weights = np.exp(log_weights - 0.5 * (np.log(lengths) / SD_LOG_LENGTH) ** 2) * _support(limbs)
    weights *= (lengths > LENGTHS[0]) & (lengths < LENGTHS[1])
    weights[_suppressed(limbs, weights)] = 0.0
    weights[weights < LEAST_WEIGHT * weights.max(initial=0.0)] = 0.0
    has_weight = weights > 0
    limbs = Limbs(*(array[has_weight] for array in limbs))
    sd_m = np.array([SD_ACROSS_M, SD_ACROSS_M, SD_ALONG_M])
    # A foot is nearly level: either end may be the ankle.
    proximal = limbs.middles if name == "foot" else limbs.upper
    return (
        strongest(segments(limbs.upper, limbs.lower, sd_m, weights[has_weight], NAME), MOST),
        strongest(landmark(proximal, SD_ALONG_M, weights[has_weight], NAME), MOST),
    )


def _support(limbs: Limbs) -> Float[np.ndarray, " limb"]:
    """Return how many limbs of all pairs of views agree with each limb. A pattern on clothes, mistaken for a limb, differs from pair to pair."""
    return (np.exp(-0.5 * (_distances(limbs) / SAME_M) ** 2) * _parallel(limbs)).sum(axis=1)


def _suppressed(limbs: Limbs, weights: Float[np.ndarray, " limb"]) -> Bool[np.ndarray, " limb"]:
    """Return which limbs are nearly the same as a limb with a larger weight."""
    same = (_distances(limbs) < SAME_M) & _parallel(limbs)
    suppressed = np.zeros(len(weights), bool)
    for k in np.argsort(-weights, kind="stable"):
        if not suppressed[k]:
            suppressed |= same[k]
            suppressed[k] = False
            same[:, k] = False
    return suppressed


def _distances(limbs: Limbs) -> Float[np.ndarray, "limb limb"]:
    return np.linalg.norm(limbs.middles[:, None] - limbs.middles, axis=2)


def _parallel(limbs: Limbs) -> Bool[np.ndarray, "limb limb"]:
    axes = (limbs.upper - limbs.lower) / np.linalg.norm(limbs.upper - limbs.lower, axis=1, keepdims=True)
    return np.abs(axes @ axes.T) > PARALLEL


def _all_limbs(scene: Scene, blobs_by_view: Sequence[Sequence[Blob]]) -> Limbs:
    pairs = [
        _pair(scene, a, b, blobs_by_view[a], blobs_by_view[b])
        for a, b in combinations(range(len(blobs_by_view)), 2)
        if blobs_by_view[a] and blobs_by_view[b]
    ]
    limbs = Limbs(*(np.concatenate(arrays) for arrays in zip(*pairs, strict=True))) if pairs else _no_limbs()
    return Limbs(*(array[_is_outside(scene, limbs.middles)] for array in limbs))


def _is_outside(scene: Scene, middles: Float[np.ndarray, "limb 3"]) -> Bool[np.ndarray, " limb"]:
    """Return whether limbs are foreground, and outside the head and the trunk of the visual hull. Limbs deep inside it are patterns on clothes."""
    is_foreground = scene.foreground(middles) >= FOREGROUND
    if scene.figure is None:
        return is_foreground
    depths = scene.depths(middles)
    return is_foreground & (depths > 0) & (depths < DEEPEST_M) & (np.linalg.norm(middles - scene.figure.crown, axis=1) > HEAD_M)


def _no_limbs() -> Limbs:
    return Limbs(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0))


def _pair(scene: Scene, a: int, b: int, first: Sequence[Blob], second: Sequence[Blob]) -> Limbs:
    """Return the limbs that the blobs of two views form."""
    cameras, viewpoints = [scene.cameras[a], scene.cameras[b]], scene.viewpoints[[a, b]]
    matches = [(p, q) for p in first for q in second if _same_colour(p.colour, q.colour)]
    if not matches:
        return _no_limbs()
    first_blobs, second_blobs = (list(matched) for matched in zip(*matches, strict=True))
    middles, errors = triangulate_pair(cameras, np.array([p.middle for p in first_blobs]), np.array([q.middle for q in second_blobs]))
    radii_px = np.array([min(p.radius, q.radius) for p, q in matches])
    axes = _axes(cameras, first_blobs, second_blobs)
    ends = [_ends(cameras[k], viewpoints[k], view_blobs, middles, axes) for k, view_blobs in enumerate((first_blobs, second_blobs))]
    lengths = np.abs(np.stack(ends)).mean(axis=0).mean(axis=1, keepdims=True)
    distances = np.linalg.norm(middles - viewpoints[:, None], axis=2)
    radii = np.mean(
        [
            [blob.radius for blob in view_blobs] * distance / max(camera.focal_px)
            for view_blobs, distance, camera in zip((first_blobs, second_blobs), distances, cameras, strict=True)
        ],
        axis=0,
    )
    with np.errstate(invalid="ignore"):
        is_limb = (
            (errors < MISS_PX + MISS * radii_px) & (radii > RADII_M[0]) & (radii < RADII_M[1]) & np.isfinite(lengths[:, 0]) & (lengths[:, 0] < 0.5)
        )
    axes = np.where(axes[:, [scene.up]] > 0, axes, -axes)
    return Limbs(middles[is_limb], (middles - lengths * axes)[is_limb], (middles + lengths * axes)[is_limb], radii[is_limb])


def _same_colour(first: Float[np.ndarray, "3"], second: Float[np.ndarray, "3"]) -> bool:
    """Return whether two blobs may be one limb by their colours. A blob with equal channels is grey, and its camera may be a grey one."""
    if min(np.ptp(first), np.ptp(second)) < 1.0:
        return True
    return bool(np.abs(first - second).max() < COLOURS)


def _axes(cameras: Sequence[CameraSpec], first_blobs: Sequence[Blob], second_blobs: Sequence[Blob]) -> Float[np.ndarray, "limb 3"]:
    """Return the directions of the lines in which the two planes through camera and blob intersect; NaN where the planes nearly coincide."""
    normals = []
    for camera, view_blobs in zip(cameras, (first_blobs, second_blobs), strict=True):
        ends = [rays(camera, np.array([blob.ends[k] for blob in view_blobs])) for k in (0, 1)]
        normal = np.cross(ends[0], ends[1])
        normals.append(normal / np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-9))
    axes = np.cross(normals[0], normals[1])
    length = np.linalg.norm(axes, axis=1, keepdims=True)
    return np.where(length > 0.2, axes / np.maximum(length, 1e-9), np.nan)


def _ends(
    camera: CameraSpec,
    viewpoint: Float[np.ndarray, "3"],
    view_blobs: Sequence[Blob],
    middles: Float[np.ndarray, "limb 3"],
    axes: Float[np.ndarray, "limb 3"],
) -> Float[np.ndarray, "limb 2"]:
    """Return where the rays through a blob's two ends pass the limb's axis, as distances from the limb's middle, metres."""
    distances = []
    for k in (0, 1):
        ray = rays(camera, np.array([blob.ends[k] for blob in view_blobs]))
        offset = viewpoint - middles
        offset_on_axis, cosine = (offset * axes).sum(axis=1), (ray * axes).sum(axis=1)
        # The point of the axis that is nearest to the ray.
        distances.append((offset_on_axis - cosine * (offset * ray).sum(axis=1)) / np.maximum(1 - cosine**2, 1e-3))
    return np.stack(distances, axis=1)
