r"""Which way a person's bones face: a *lateral* (towards the person's left) for each bone, its *ahead* is direction x lateral.

A knee or an elbow that is bent says it by its plane; a straight one takes it from the trunk, turned the shortest way onto the bone:
$R(a \to b)\,v = v - \frac{(a + b) \cdot v}{1 + a \cdot b}\,(a + b) + 2 (a \cdot v)\,b$.
"""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.ndimage import gaussian_filter1d

from bayes_body.simulation.person_motion import Track, unit

# Between these sines of its angle a joint's plane takes over from the trunk.
STRAIGHT, BENT = 0.15, 0.45
# Standard deviation of the smoothing over time, seconds.
STEADY_S = 0.04


class Chain(NamedTuple):
    """A bent tube's bones, over time.

    Attributes:
        points: (frame, bone + 1, 3), where bones meet.
        laterals: (frame, bone, 3), unit, across each bone.
        bend: (frame, bone - 1), angle between neighbours, radians.
    """

    points: Float[np.ndarray, "frame point 3"]
    laterals: Float[np.ndarray, "frame bone 3"]
    bend: Float[np.ndarray, "frame joint"]


def chain(points: list[Track], laterals: list[Track]) -> Chain:
    """The chain through some points, its laterals made exactly square to the bones."""
    joints = np.stack(points, axis=1)
    directions = unit(np.diff(joints, axis=1))
    cosines = np.sum(directions[:, 1:] * directions[:, :-1], axis=-1)
    return Chain(joints, across(np.stack(laterals, axis=1), directions), np.arccos(np.clip(cosines, -1.0, 1.0)))


def across(vectors: Float[np.ndarray, "*batch 3"], directions: Float[np.ndarray, "*batch 3"]) -> Float[np.ndarray, "*batch 3"]:
    """The part of the vectors that is square to unit directions, as unit vectors."""
    return unit(vectors - np.sum(vectors * directions, axis=-1, keepdims=True) * directions)


def trunk_axes(whole: Mapping[str, Track], fps: float) -> tuple[Track, Track, Track]:
    """The trunk's up, the pelvis's left and the shoulders' left, unit vectors."""
    hips, shoulders = (whole[f"l_{name}"] - whole[f"r_{name}"] for name in ("hip", "shoulder"))
    up = unit(middle(whole, "shoulder") - middle(whole, "hip"))
    return up, across(steady(hips, fps), up), across(steady(shoulders, fps), up)


def middle(whole: Mapping[str, Track], name: str) -> Track:
    """The point halfway between a left and a right landmark."""
    return (whole[f"l_{name}"] + whole[f"r_{name}"]) / 2


def hinge_laterals(upper: Track, lower: Track, up: Track, left: Track, forwards: bool, fps: float) -> tuple[Track, Track]:
    """The laterals of a limb's two bones, which share a hinge.

    Args:
        upper: (frame, 3), along the thigh or the upper arm.
        lower: along the shank or the forearm.
        up: the trunk's.
        left: the trunk's.
        forwards: whether the hinge bends forwards, as an elbow, or backwards, as a knee.
        fps: frames a second.
    """
    upper, lower = unit(upper), unit(lower)
    trunk = turned(-up, upper, left)
    hinge = np.cross(lower, upper) if forwards else np.cross(upper, lower)
    sine = np.linalg.norm(hinge, axis=1, keepdims=True)
    # A hinge that faces away from the trunk's left is a limb bent past straight, or twisted further than its plane can tell.
    agrees = np.clip(2.0 * np.sum(unit(hinge) * trunk, axis=1, keepdims=True) + 1.0, 0.0, 1.0)
    weight = agrees * np.clip((sine - STRAIGHT) / (BENT - STRAIGHT), 0.0, 1.0)
    lateral = steady(weight * unit(hinge) + (1.0 - weight) * trunk, fps)
    return across(lateral, upper), across(lateral, lower)


def turned(start: Track, end: Track, vectors: Track) -> Track:
    """The vectors, turned as the shortest rotation turns the unit vectors `start` onto `end`."""
    both = start + end
    along = np.sum(both * vectors, axis=1, keepdims=True) / np.maximum(1.0 + np.sum(start * end, axis=1, keepdims=True), 1e-3)
    return unit(vectors - along * both + 2.0 * np.sum(start * vectors, axis=1, keepdims=True) * end)


def steady(vectors: Track, fps: float) -> Track:
    """Directions, smoothed over time."""
    return unit(gaussian_filter1d(vectors, max(STEADY_S * fps, 1e-3), axis=0, mode="nearest"))
