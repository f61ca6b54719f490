"""Prepare a motion for filming: cut it, scale it to a person, and move it to where the cameras look."""

from collections.abc import Mapping
from itertools import pairwise

import numpy as np
from jaxtyping import Float

from bayes_body.base.errors import input_error
from bayes_body.recording.evidence.markers import MARKERS

type Landmarks = Mapping[str, Float[np.ndarray, "frame 3"]]
# Height from the crown down to the ankle, over stature; the rest is the foot (Drillis & Contini 1966: 0.039 H).
DOWN_TO_ANKLE = 1 - 0.039
SPINE = ("head", "thorax", "pelvis")


def stacked(landmarks: Landmarks) -> Float[np.ndarray, "frame 15 3"]:
    """The 15 markers as one array, in their order, metres.

    Raises:
        InputError: one is missing.
    """
    missing = [name for name in MARKERS if name not in landmarks]
    if missing:
        raise input_error("the motion's landmarks", f"no {', '.join(missing)}", f"each of {', '.join(MARKERS)}", "name the file's joints")
    return np.stack([np.asarray(landmarks[name], np.float64) for name in MARKERS], axis=1)


def stature_m(landmarks: Landmarks) -> float:
    """The person's stature: the sum of the segments from crown to ankle (median over time of each), plus the foot."""
    points = dict(zip(MARKERS, np.moveaxis(stacked(landmarks), 1, 0), strict=True))
    hips = (points["l_hip"] + points["r_hip"]) / 2
    spine = [*(points[name] for name in SPINE), hips]
    stretches = [np.linalg.norm(a - b, axis=-1) for a, b in pairwise(spine)]
    for upper, lower in (("hip", "knee"), ("knee", "ankle")):
        lengths = [np.linalg.norm(points[f"{side}_{upper}"] - points[f"{side}_{lower}"], axis=-1) for side in "lr"]
        stretches.append(np.mean(lengths, axis=0))
    return float(sum(np.nanmedian(stretch) for stretch in stretches) / DOWN_TO_ANKLE)


def scaled(landmarks: Landmarks, factor: float) -> dict[str, Float[np.ndarray, "frame 3"]]:
    """The motion of a person who is larger by a factor. The floor stays at height 0; strides are scaled too."""
    return {name: factor * np.asarray(track, np.float64) for name, track in landmarks.items()}


def centred(landmarks: Landmarks, aim_m: Float[np.ndarray, "3"]) -> dict[str, Float[np.ndarray, "frame 3"]]:
    """The motion, moved so that the middle of the pelvis's path is above the point that the cameras look at. Heights do not change."""
    way = np.asarray(landmarks["pelvis"], np.float64)
    shift = aim_m - (np.nanmin(way, axis=0) + np.nanmax(way, axis=0)) / 2
    shift[2] = 0.0
    return {name: track + shift for name, track in landmarks.items()}


def put(landmarks: Landmarks, aim_m: Float[np.ndarray, "3"], place: tuple[float, float, float]) -> dict[str, Float[np.ndarray, "frame 3"]]:
    """The motion at a place of the floor: turned about the vertical, and the middle of the pelvis's path moved.

    Args:
        landmarks: the motion.
        aim_m: the point that the cameras look at.
        place: x and y from that point, metres, and the turn from x towards y, degrees.
    """
    x, y, degrees = place
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    R = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    return centred({name: np.asarray(track, np.float64) @ R.T for name, track in landmarks.items()}, aim_m + np.array([x, y, 0.0]))


def cut(landmarks: Landmarks, first: int, frames: int | None) -> dict[str, Float[np.ndarray, "left 3"]]:
    """`frames` frames of the motion from `first` on; all remaining ones if no number is given.

    Raises:
        InputError: the motion has no such frames.
    """
    length = len(next(iter(landmarks.values())))
    if not 0 <= first < length:
        raise input_error(
            "--first-frame", f"{first}", f"0 to {length - 1}, the motion has {length} frames at the rig's rate", "name an earlier frame"
        )
    if frames is not None and not 1 <= frames <= length - first:
        raise input_error("--frames", f"{frames}", f"1 to {length - first}, the motion has no more at the rig's rate", "lower it, or leave it out")
    return {name: track[first : None if frames is None else first + frames] for name, track in landmarks.items()}
