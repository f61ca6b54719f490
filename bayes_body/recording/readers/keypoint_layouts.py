"""Keypoint layouts: the orders in which pose estimators list a body's keypoints, with this project's names.

BODY_25 and BODY_25B (OpenPose's released and experimental network) both have 25 keypoints, and a file does not say which it holds. The wrong order
gives a skeleton with implausible proportions. Limb lengths in the image, foreshortened, divided by their mean proportions (Drillis & Contini 1966,
fractions of stature), spread by 10 to 20 % in the right order, and by about 40 % where eyes are mistaken for elbows.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from bayes_body.base.errors import InputError, input_error, nearest

_COCO = (
    *("nose", "l_eye", "r_eye", "l_ear", "r_ear", "l_shoulder", "r_shoulder", "l_elbow", "r_elbow", "l_wrist", "r_wrist"),
    *("l_hip", "r_hip", "l_knee", "r_knee", "l_ankle", "r_ankle"),
)
_OPENPOSE_ARMS = ("nose", "neck", "r_shoulder", "r_elbow", "r_wrist", "l_shoulder", "l_elbow", "l_wrist")
_OPENPOSE_LEGS = ("r_hip", "r_knee", "r_ankle", "l_hip", "l_knee", "l_ankle")
_OPENPOSE_FACE = ("r_eye", "l_eye", "r_ear", "l_ear")
_OPENPOSE_FEET = ("l_big_toe", "l_small_toe", "l_heel", "r_big_toe", "r_small_toe", "r_heel")
# `head` is the crown; `neck` is the point between the shoulders (BODY_25, COCO_18, HALPE_26); `upper_neck` is just below the skull.
LAYOUTS: dict[str, tuple[str, ...]] = {
    "COCO_17": _COCO,
    "COCO_18": (*_OPENPOSE_ARMS, *_OPENPOSE_LEGS, *_OPENPOSE_FACE),
    "BODY_25": (*_OPENPOSE_ARMS, "mid_hip", *_OPENPOSE_LEGS, *_OPENPOSE_FACE, *_OPENPOSE_FEET),
    "BODY_25B": (*_COCO, "upper_neck", "head", *_OPENPOSE_FEET),
    "HALPE_26": (*_COCO, "head", "neck", "mid_hip", "l_big_toe", "r_big_toe", "l_small_toe", "r_small_toe", "l_heel", "r_heel"),
}
# Fractions of stature; the trunk goes from shoulder to hip.
PROPORTIONS = {("shoulder", "elbow"): 0.186, ("elbow", "wrist"): 0.146, ("hip", "knee"): 0.245, ("knee", "ankle"): 0.246, ("shoulder", "hip"): 0.288}
# For a decision, the spread in the wrong order must be this many times as large.
CLEARLY = 1.5


class Layout(NamedTuple):
    """An order of keypoints: its name, the names of the keypoints, and a remark if the order was inferred (else None)."""

    name: str
    keypoints: tuple[str, ...]
    remark: str | None = None


def choose_layout(points: Float[np.ndarray, "person keypoint 3"], name: str | None = None) -> Layout:
    """Choose the order of the keypoints, from many people and frames.

    Args:
        points: column, row (pixels; NaN where not seen) and confidence.
        name: the order that the user names; None: the number of keypoints decides, then the body's proportions.

    Raises:
        InputError: no order of that name or with this number of keypoints, or the data do not decide.
    """
    count = points.shape[1]
    fitting = [layout for layout, keypoints in LAYOUTS.items() if len(keypoints) == count]
    if name is not None:
        if name not in LAYOUTS:
            raise InputError(f"--layout: '{name}': no such order; {nearest(name, LAYOUTS)}")
        if name not in fitting:
            raise input_error(
                f"--layout {name}", f"{count} keypoints per person", f"{len(LAYOUTS[name])}", "name the order in which the keypoints are written"
            )
        return Layout(name, LAYOUTS[name])
    if not fitting:
        known = ", ".join(f"{layout} ({len(keypoints)})" for layout, keypoints in LAYOUTS.items())
        raise input_error("keypoints", f"{count} per person", known, "write them in one of these orders")
    if len(fitting) == 1:
        return Layout(fitting[0], LAYOUTS[fitting[0]])
    return _by_proportions(points, fitting)


def _by_proportions(points: Float[np.ndarray, "person keypoint 3"], names: list[str]) -> Layout:
    spreads = {name: disproportion(points, LAYOUTS[name]) for name in names}
    best, second = sorted(names, key=lambda name: spreads[name])[:2]
    if not spreads[second] > CLEARLY * spreads[best]:
        remedy = f"choose one with --layout {best} or --layout {second}"
        raise input_error(
            "keypoints", f"{points.shape[1]} per person, which may be {' or '.join(names)}", "people whose limb lengths decide between them", remedy
        )
    reason = f"limb lengths differ from a body's proportions by {spreads[best]:.0%}, and by {spreads[second]:.0%} in the order {second}"
    return Layout(best, LAYOUTS[best], f"The keypoints are read as {best}: {reason}.")


def disproportion(points: Float[np.ndarray, "person keypoint 3"], keypoints: tuple[str, ...]) -> float:
    """How far limb lengths are from a body's proportions in that order: mean |log(length / fraction)| about its median, median over people.

    Infinite if no person shows half of the limbs.
    """
    index = {name: i for i, name in enumerate(keypoints)}
    ends = np.array([[index[f"{side}_{a}"], index[f"{side}_{b}"]] for side in "lr" for a, b in PROPORTIONS])
    where = np.where(points[..., 2:] > 0, points[..., :2], np.nan)
    lengths = np.linalg.norm(where[:, ends[:, 0]] - where[:, ends[:, 1]], axis=-1)
    # A limb seen end-on has almost no length; one pixel keeps its logarithm finite.
    ratios = np.log(np.maximum(lengths, 1.0) / np.tile(list(PROPORTIONS.values()), 2))
    ratios = ratios[np.isfinite(ratios).sum(axis=1) >= len(PROPORTIONS)]
    if not len(ratios):
        return float("inf")
    return float(np.median(np.nanmean(np.abs(ratios - np.nanmedian(ratios, axis=1, keepdims=True)), axis=1)))
