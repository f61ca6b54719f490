r"""From a motion's landmarks to the chains of bones that carry a person's tubes, and the orientations of these bones.

Each bone has a *lateral* (towards the person's left); its *ahead* is direction x lateral. At a bent knee or elbow, the joint's plane determines the
lateral. At a straight one, it is that of the trunk, rotated by the smallest rotation onto the bone:
$R(a \to b)\,v = v - \frac{(a + b) \cdot v}{1 + a \cdot b}\,(a + b) + 2 (a \cdot v)\,b$.
"""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.ndimage import gaussian_filter1d

from bayes_body.workshop.simulation.person_motion import Track, unit

# Between these sines of its angle, a joint's plane gradually replaces the trunk.
STRAIGHT, BENT = 0.15, 0.45
# Standard deviation of the smoothing over time, seconds.
STEADY_S = 0.04


class Chain(NamedTuple):
    """The bones of a bent tube, over time.

    Attributes:
        points: (frame, bone + 1, 3), the ends of the bones.
        laterals: (frame, bone, 3), unit, across each bone.
        bend: (frame, bone - 1), angle between neighbouring bones, radians.
    """

    points: Float[np.ndarray, "frame point 3"]
    laterals: Float[np.ndarray, "frame bone 3"]
    bend: Float[np.ndarray, "frame joint"]


def chain(points: list[Track], laterals: list[Track]) -> Chain:
    """The chain through some points, with laterals made exactly perpendicular to the bones."""
    joints = np.stack(points, axis=1)
    directions = unit(np.diff(joints, axis=1))
    cosines = np.sum(directions[:, 1:] * directions[:, :-1], axis=-1)
    return Chain(joints, perpendicular(np.stack(laterals, axis=1), directions), np.arccos(np.clip(cosines, -1.0, 1.0)))


def perpendicular(vectors: Float[np.ndarray, "*batch 3"], directions: Float[np.ndarray, "*batch 3"]) -> Float[np.ndarray, "*batch 3"]:
    """The part of the vectors that is perpendicular to unit directions, as unit vectors."""
    return unit(vectors - np.sum(vectors * directions, axis=-1, keepdims=True) * directions)


def trunk_axes(landmarks: Mapping[str, Track], fps: float) -> tuple[Track, Track, Track]:
    """The trunk's up, the pelvis's left and the shoulders' left, unit vectors."""
    hips, shoulders = (landmarks[f"l_{name}"] - landmarks[f"r_{name}"] for name in ("hip", "shoulder"))
    up = unit(middle(landmarks, "shoulder") - middle(landmarks, "hip"))
    return up, perpendicular(steady(hips, fps), up), perpendicular(steady(shoulders, fps), up)


def middle(landmarks: Mapping[str, Track], name: str) -> Track:
    """The midpoint of a left and a right landmark."""
    return (landmarks[f"l_{name}"] + landmarks[f"r_{name}"]) / 2


def hinge_laterals(upper: Track, lower: Track, up: Track, trunk_left: Track, forwards: bool, fps: float) -> tuple[Track, Track]:
    """The laterals of a limb's two bones, which share a hinge.

    Args:
        upper: (frame, 3), along the thigh or the upper arm.
        lower: along the shank or the forearm.
        up: the trunk's up.
        trunk_left: the trunk's left.
        forwards: whether the hinge bends forwards, like an elbow, or backwards, like a knee.
        fps: frames per second.
    """
    upper, lower = unit(upper), unit(lower)
    trunk = turned(-up, upper, trunk_left)
    hinge = np.cross(lower, upper) if forwards else np.cross(upper, lower)
    sine = np.linalg.norm(hinge, axis=1, keepdims=True)
    # A hinge axis that points away from the trunk's left means a limb bent past straight, or twisted too far for its plane to be used.
    agrees = np.clip(2.0 * np.sum(unit(hinge) * trunk, axis=1, keepdims=True) + 1.0, 0.0, 1.0)
    weight = agrees * np.clip((sine - STRAIGHT) / (BENT - STRAIGHT), 0.0, 1.0)
    lateral = steady(weight * unit(hinge) + (1.0 - weight) * trunk, fps)
    return perpendicular(lateral, upper), perpendicular(lateral, lower)


def turned(start: Track, end: Track, vectors: Track) -> Track:
    """The vectors, rotated by the smallest rotation that maps the unit vectors `start` to `end`."""
    bisector = start + end
    projection = np.sum(bisector * vectors, axis=1, keepdims=True) / np.maximum(1.0 + np.sum(start * end, axis=1, keepdims=True), 1e-3)
    return unit(vectors - projection * bisector + 2.0 * np.sum(start * vectors, axis=1, keepdims=True) * end)


def steady(vectors: Track, fps: float) -> Track:
    """Directions, smoothed over time."""
    return unit(gaussian_filter1d(vectors, max(STEADY_S * fps, 1e-3), axis=0, mode="nearest"))


# Height of a head from crown to chin, over stature; between it and the shoulders is the neck.
HEAD_OVER_STATURE = 0.132
LARGEST_HEAD = 0.80
# How far the trunk's tube extends above the shoulders and below the hips, over the trunk's length.
# Length of a hand from wrist to finger ends, over stature (ANSUR 1988: 0.110). A motion's hand gives only the direction.
SHORTEST_HAND, LONGEST_HAND = 0.098, 0.115
ABOVE, BELOW = 0.17, 0.27
SHALLOWEST_SOLE_M, DEEPEST_SOLE_M = 0.055, 0.10


def chains(landmarks: Mapping[str, Track], height_m: float, fps: float) -> dict[str, Chain]:
    """Each tube's chain over time.

    Args:
        landmarks: complete landmarks.
        height_m: the person's stature, which gives the sizes of parts without landmarks.
        fps: frames per second.
    """
    up, hips, shoulders = trunk_axes(landmarks, fps)
    bones = {"trunk": _trunk(landmarks, up, hips, shoulders), "head": _head(landmarks, up, shoulders, height_m)}
    for side, sign in (("l", 1.0), ("r", -1.0)):
        bones[f"{side}_arm"], bones[f"{side}_thumb"] = _arm(landmarks, side, sign, (up, shoulders), height_m, fps)
        bones[f"{side}_leg"], lateral = _leg(landmarks, side, up, hips, fps)
        bones[f"{side}_foot"] = _foot(landmarks, side, lateral, height_m)
    return bones


def _trunk(landmarks: Mapping[str, Track], up: Track, hips: Track, shoulders: Track) -> Chain:
    low, high = middle(landmarks, "hip"), middle(landmarks, "shoulder")
    rise = high - low
    return chain([high + ABOVE * rise, (low + high) / 2, low - BELOW * rise], [shoulders, hips])


def _head(landmarks: Mapping[str, Track], up: Track, shoulders: Track, height_m: float) -> Chain:
    crown, neck = landmarks["head"], landmarks["neck"]
    high = middle(landmarks, "shoulder")
    axis = unit(unit(crown - neck) + 0.5 * up)
    length = np.minimum(HEAD_OVER_STATURE * height_m, LARGEST_HEAD * np.linalg.norm(crown - high, axis=1))[:, None]
    return chain([crown, crown - length * axis, high + 0.02 * up], [shoulders, shoulders])


def _arm(landmarks: Mapping[str, Track], side: str, sign: float, chest: tuple[Track, Track], height_m: float, fps: float) -> tuple[Chain, Chain]:
    up, trunk_left = chest
    shoulder, elbow, wrist, hand = (landmarks[f"{side}_{name}"] for name in ("shoulder", "elbow", "wrist", "hand"))
    # The finger ends are the least reliable points of a capture.
    hand_axis = steady(unit(hand - wrist), fps)
    size = np.clip(np.linalg.norm(hand - wrist, axis=1, keepdims=True), SHORTEST_HAND * height_m, LONGEST_HAND * height_m)
    hand = wrist + size * hand_axis
    root = shoulder + 0.72 * (middle(landmarks, "shoulder") - shoulder) + 0.03 * up
    upper, lower = hinge_laterals(elbow - shoulder, wrist - elbow, up, trunk_left, forwards=True, fps=fps)
    girdle = turned(-up, unit(shoulder - root), trunk_left)
    arm = chain([root, shoulder, elbow, wrist, hand], [girdle, upper, lower, lower])
    lateral = arm.laterals[:, 3]
    forward = np.cross(hand_axis, lateral)
    base = wrist + size * (0.10 * hand_axis + 0.06 * forward)
    tip = wrist + size * (0.58 * hand_axis + 0.34 * forward - sign * 0.10 * lateral)
    return arm, chain([base, tip], [lateral])


def _leg(landmarks: Mapping[str, Track], side: str, up: Track, trunk_left: Track, fps: float) -> tuple[Chain, Track]:
    hip, knee, ankle = (landmarks[f"{side}_{name}"] for name in ("hip", "knee", "ankle"))
    upper, lower = hinge_laterals(knee - hip, ankle - knee, up, trunk_left, forwards=False, fps=fps)
    pelvis = perpendicular(trunk_left, up)
    return chain([hip + 0.06 * up, hip, knee, ankle], [pelvis, upper, lower]), lower


def _foot(landmarks: Mapping[str, Track], side: str, lateral: Track, height_m: float) -> Chain:
    """A shoe's sole from behind the heel to beyond the toes. The height of the ankle above it is measured where the foot is flat."""
    ankle, toe = landmarks[f"{side}_ankle"], landmarks[f"{side}_toe"]
    reach = toe - ankle
    flat = np.argsort(ankle[:, 2] + toe[:, 2])[: max(1, len(ankle) // 8)]
    sink = np.arctan2(-np.median(reach[flat, 2]), np.median(np.linalg.norm(reach[flat, :2], axis=1)))
    lateral = perpendicular(lateral, unit(reach))
    # Rotate about the person's right by the angle of the slope.
    sole = unit(unit(reach) * np.cos(sink) + np.cross(-lateral, unit(reach)) * np.sin(sink))
    above = np.cross(sole, lateral)
    depth = np.clip(np.median(ankle[flat, 2]), SHALLOWEST_SOLE_M, DEEPEST_SOLE_M)
    heel = ankle - depth * above - 0.035 * height_m * sole
    length = max(0.152 * height_m, 0.035 * height_m + 0.02 + float(np.median(np.linalg.norm(reach, axis=1)) * np.cos(sink)))
    return chain([heel, heel + length * sole], [lateral])
