r"""How far a person's keypoints are from a body's proportions, if they are read in some order.

With the length $l_{bp}$ of distance b between two points in pose p, and its mean share $f_b$ of stature, the deviation is
$d_{bp} = |\log(l_{bp} / f_b) - s_p|$, where the scale $s_p$ is the median of $\log(l / f)$ over the limbs. In a picture, foreshortening shortens.
Hence the distances between points of the head, the feet, and the two sides only count where they are too long. A distance's deviation is a low
percentile over many poses, so that wrong detections do not count; the misfit is the mean over the distances.

Seen from the side, the misfit is below 0.1 in the right order, and below 0.25 with a third of wrong detections. In an order in which points have
another's place it is 0.12 to 0.7. Seen along its axis, a body has no proportions (`tests/recording/readers/test_keypoint_orders.py`).
Proportions: Drillis & Contini 1966; those of a network's points of the head and feet are rounded up.
"""

import warnings
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

# Shares of stature; the trunk goes from shoulder to hip.
LIMBS = {("shoulder", "elbow"): 0.175, ("elbow", "wrist"): 0.146, ("hip", "knee"): 0.245, ("knee", "ankle"): 0.246, ("shoulder", "hip"): 0.288}
# Of these, `SLACK` times as much is not too long.
_MIDDLE = {("l_shoulder", "r_shoulder"): 0.21, ("l_hip", "r_hip"): 0.12, ("neck", "nose"): 0.15, ("neck", "mid_hip"): 0.29}
_CROWN = {("head", "nose"): 0.10, ("head", "neck"): 0.18, ("upper_neck", "nose"): 0.09, ("upper_neck", "head"): 0.13}
_SIDES = {
    **{("neck", "shoulder"): 0.11, ("mid_hip", "hip"): 0.06, ("upper_neck", "shoulder"): 0.12, ("nose", "shoulder"): 0.19},
    **{("nose", "eye"): 0.03, ("eye", "ear"): 0.055, ("nose", "ear"): 0.08, ("ear", "shoulder"): 0.17},
    **{("ankle", "heel"): 0.055, ("ankle", "big_toe"): 0.12, ("ankle", "small_toe"): 0.12, ("big_toe", "small_toe"): 0.05, ("heel", "big_toe"): 0.14},
}
UNPAIRED = ("nose", "neck", "upper_neck", "head", "mid_hip")
SLACK = 1.3
# A larger deviation says no more.
LARGEST_DEVIATION = 1.4
PERCENTILE = 30
# A pose must show half of the limbs, and a distance must be in a few poses.
FEWEST_LIMBS, FEWEST_LENGTHS = 5, 3
# More poses do not change a percentile.
MOST_POSES = 2000

type Poses = Float[np.ndarray, "pose keypoint dimension"]


class _Spans(NamedTuple):
    """Distances between pairs of points: the places of their ends in the order, and the share of stature."""

    ends: Int[np.ndarray, "span 2"]
    shares: Float[np.ndarray, " span"]


def misfit(poses: Poses, keypoints: tuple[str, ...]) -> float:
    """Mean deviation from a body's proportions (see the module); infinite if no pose shows half of the limbs.

    Args:
        poses: of one or more people, in pixels or metres; NaN where not found.
        keypoints: the names of the points in the order that is tried.
    """
    deviations, limbs = _deviations(poses[:: max(1, len(poses) // MOST_POSES)], keypoints)
    deviations[:, np.isfinite(deviations).sum(axis=0) < FEWEST_LENGTHS] = np.nan
    if np.isfinite(deviations[:, :limbs]).any(axis=0).sum() < FEWEST_LIMBS:
        return np.inf
    spans = deviations[:, np.isfinite(deviations).any(axis=0)]
    return float(np.mean(np.nanpercentile(spans, PERCENTILE, axis=0)))


def pose_misfits(poses: Poses, keypoints: tuple[str, ...]) -> Float[np.ndarray, " pose"]:
    """Mean deviation of each pose alone, which wrong detections spoil; NaN where half of the limbs are not seen."""
    deviations, _ = _deviations(poses, keypoints)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)
        return np.nanmean(deviations, axis=1)


def _deviations(poses: Poses, keypoints: tuple[str, ...]) -> tuple[Float[np.ndarray, "pose span"], int]:
    """The deviation of each distance, at most LARGEST_DEVIATION; NaN where not seen. Also returns how many of them are limbs; they come first."""
    limbs, spans = _spans(keypoints)
    log_limbs, log_spans = _log_ratios(poses, limbs), _log_ratios(poses, spans)
    log_limbs[np.isfinite(log_limbs).sum(axis=1) < FEWEST_LIMBS] = np.nan
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)
        scale = np.nanmedian(log_limbs, axis=1, keepdims=True)
    too_long = np.maximum(log_spans - scale - np.log(SLACK), 0)
    return np.minimum(np.concatenate([np.abs(log_limbs - scale), too_long], axis=1), LARGEST_DEVIATION), len(limbs.shares)


def _log_ratios(poses: Poses, spans: _Spans) -> Float[np.ndarray, "pose span"]:
    lengths = np.linalg.norm(poses[:, spans.ends[:, 0]] - poses[:, spans.ends[:, 1]], axis=-1)
    # A limb seen end-on has almost no length.
    return np.log(np.maximum(lengths, 1e-6) / spans.shares)


def _spans(keypoints: tuple[str, ...]) -> tuple[_Spans, _Spans]:
    """The limbs, and the other distances, between points of these names."""
    paired = {(_on_side(a, side), _on_side(b, side)): share for side in "lr" for (a, b), share in _SIDES.items()}
    limbs = {(f"{side}_{a}", f"{side}_{b}"): share for side in "lr" for (a, b), share in LIMBS.items()}
    return _indexed(limbs, keypoints), _indexed(_MIDDLE | _CROWN | paired, keypoints)


def _on_side(name: str, side: str) -> str:
    return name if name in UNPAIRED else f"{side}_{name}"


def _indexed(shares: dict[tuple[str, str], float], keypoints: tuple[str, ...]) -> _Spans:
    place = {name: k for k, name in enumerate(keypoints)}
    named = {ends: share for ends, share in shares.items() if set(ends) <= place.keys()}
    return _Spans(np.array([[place[a], place[b]] for a, b in named], int).reshape(-1, 2), np.array(list(named.values())))
