r"""The orientation of a person's bones: each bone has a *lateral* (towards the person's left); its *ahead* is direction x lateral.

A bent knee or elbow gives it by its plane. A straight one takes it from the trunk, rotated by the smallest rotation onto the bone:
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
    return Chain(joints, across(np.stack(laterals, axis=1), directions), np.arccos(np.clip(cosines, -1.0, 1.0)))


def across(vectors: Float[np.ndarray, "*batch 3"], directions: Float[np.ndarray, "*batch 3"]) -> Float[np.ndarray, "*batch 3"]:
    """The part of the vectors that is perpendicular to unit directions, as unit vectors."""
    return unit(vectors - np.sum(vectors * directions, axis=-1, keepdims=True) * directions)


def trunk_axes(whole: Mapping[str, Track], fps: float) -> tuple[Track, Track, Track]:
    """The trunk's up, the pelvis's left and the shoulders' left, unit vectors."""
    hips, shoulders = (whole[f"l_{name}"] - whole[f"r_{name}"] for name in ("hip", "shoulder"))
    up = unit(middle(whole, "shoulder") - middle(whole, "hip"))
    return up, across(steady(hips, fps), up), across(steady(shoulders, fps), up)


def middle(whole: Mapping[str, Track], name: str) -> Track:
    """The midpoint of a left and a right landmark."""
    return (whole[f"l_{name}"] + whole[f"r_{name}"]) / 2


def hinge_laterals(upper: Track, lower: Track, up: Track, left: Track, forwards: bool, fps: float) -> tuple[Track, Track]:
    """The laterals of a limb's two bones, which share a hinge.

    Args:
        upper: (frame, 3), along the thigh or the upper arm.
        lower: along the shank or the forearm.
        up: the trunk's up.
        left: the trunk's left.
        forwards: whether the hinge bends forwards, like an elbow, or backwards, like a knee.
        fps: frames per second.
    """
    upper, lower = unit(upper), unit(lower)
    trunk = turned(-up, upper, left)
    hinge = np.cross(lower, upper) if forwards else np.cross(upper, lower)
    sine = np.linalg.norm(hinge, axis=1, keepdims=True)
    # A hinge axis that points away from the trunk's left means a limb bent past straight, or twisted too far for its plane to be used.
    agrees = np.clip(2.0 * np.sum(unit(hinge) * trunk, axis=1, keepdims=True) + 1.0, 0.0, 1.0)
    weight = agrees * np.clip((sine - STRAIGHT) / (BENT - STRAIGHT), 0.0, 1.0)
    lateral = steady(weight * unit(hinge) + (1.0 - weight) * trunk, fps)
    return across(lateral, upper), across(lateral, lower)


def turned(start: Track, end: Track, vectors: Track) -> Track:
    """The vectors, rotated by the smallest rotation that maps the unit vectors `start` to `end`."""
    both = start + end
    along = np.sum(both * vectors, axis=1, keepdims=True) / np.maximum(1.0 + np.sum(start * end, axis=1, keepdims=True), 1e-3)
    return unit(vectors - along * both + 2.0 * np.sum(start * vectors, axis=1, keepdims=True) * end)


def steady(vectors: Track, fps: float) -> Track:
    """Directions, smoothed over time."""
    return unit(gaussian_filter1d(vectors, max(STEADY_S * fps, 1e-3), axis=0, mode="nearest"))
