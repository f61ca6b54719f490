r"""The subject's stature by the keypoints of two or more cameras: a unit of length that is wrong makes a giant or a doll.

A limb of median length l over frames and both sides, whose mean share of stature is f (proportions.py), tells a stature of l / f. The median over the
limbs is used if they agree; it does not depend on whether the person stands, sits or lies.
"""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from bayes_body.base.errors import input_error
from bayes_body.recording.readers.agreement.cameras import LEAST_CONFIDENCE, spread_frames
from bayes_body.recording.readers.keypoints.proportions import LIMBS
from bayes_body.recording.readers.keypoints.triangulate import triangulate
from bayes_body.recording.readers.options import METRES
from bayes_body.recording.session.session import CameraSpec

# Metres. From a child of one year to a giant. A baby, who may be as short as SHORTEST_BABY_M, is believed if --height says so.
SHORTEST_M, TALLEST_M, USUAL_M = 0.75, 2.3, 1.7
SHORTEST_BABY_M = 0.4
# Of limbs: how many must agree, on how many lengths of each, within which factor of the median, and with which relative scatter over frames.
FEWEST_LIMBS, FEWEST_LENGTHS, LARGEST_FACTOR, LARGEST_SCATTER = 3, 5, 1.5, 0.25
# Stature and --height by which people differ from the mean proportions, and networks from the joints' centres.
LARGEST_CONTRADICTION = 1.25

NAMES = {
    **{("shoulder", "elbow"): "upper arm", ("elbow", "wrist"): "forearm", ("shoulder", "hip"): "trunk"},
    **{("hip", "knee"): "thigh", ("knee", "ankle"): "calf"},
}


class Stature(NamedTuple):
    """The subject's stature, and the median lengths of the limbs that tell it, metres."""

    stature_m: float
    limbs_m: Mapping[str, float]


def triangulated_body(
    cameras: Sequence[CameraSpec], keypoints: Float[np.ndarray, "camera frame keypoint 3"]
) -> Float[np.ndarray, "chosen keypoint 3"]:
    """The subject's points in up to some hundred frames, metres; NaN where not found. No frames with fewer than two cameras.

    Args:
        cameras: calibrated.
        keypoints: column, row (pixels; NaN where not found) and confidence.
    """
    if len(cameras) < 2:
        return np.zeros((0, keypoints.shape[2], 3))
    chosen = keypoints[:, spread_frames(keypoints, 0)]
    chosen = np.where(chosen[..., 2:] >= LEAST_CONFIDENCE, chosen, np.nan)
    return triangulate(cameras, chosen.reshape(len(cameras), -1, 3)).points_m.reshape(-1, keypoints.shape[2], 3)


def measure_stature(body: Float[np.ndarray, "frame keypoint 3"], names: Sequence[str]) -> Stature | None:
    """Measure the subject on triangulated keypoints, metres, of these names; None if too few limbs agree."""
    place = {name: k for k, name in enumerate(names)}
    pairs = {limb: [(f"{side}_{limb[0]}", f"{side}_{limb[1]}") for side in "lr"] for limb in LIMBS}
    limbs = {}
    for limb, ends in pairs.items():
        sides = [body[:, place[a]] - body[:, place[b]] for a, b in ends if a in place and b in place]
        lengths = np.linalg.norm(np.concatenate(sides), axis=-1) if sides else np.zeros(0)
        lengths = lengths[np.isfinite(lengths)]
        if len(lengths) >= FEWEST_LENGTHS and np.median(np.abs(lengths - np.median(lengths))) <= LARGEST_SCATTER * np.median(lengths):
            limbs[limb] = float(np.median(lengths))
    statures = np.array([length / LIMBS[limb] for limb, length in limbs.items()])
    if len(limbs) < FEWEST_LIMBS or np.abs(np.log(statures / np.median(statures))).max() > np.log(LARGEST_FACTOR):
        return None
    return Stature(float(np.median(statures)), {NAMES[limb]: length for limb, length in limbs.items()})


def check_stature(stature: Stature | None, height_m: float | None = None, unit: str | None = None) -> list[str]:
    """Refuse a subject who is no person: the unit of length is wrong. Returns a sentence if only the given height is contradicted.

    Args:
        stature: as measured.
        height_m: as the user gives it.
        unit: of the calibration's translations, if the user can give another one.

    Raises:
        InputError: the subject is much too small or too tall, or as tall as the user says only in another unit.
    """
    if stature is None:
        return []
    if height_m is None:
        contradicts = not SHORTEST_M <= stature.stature_m <= TALLEST_M
    else:
        contradicts = not 1 / LARGEST_CONTRADICTION <= stature.stature_m / height_m <= LARGEST_CONTRADICTION
    if not contradicts:
        return []
    better_unit = _better_unit(stature.stature_m, height_m, unit)
    limbs = ", ".join(f"{limb} {length:.2g} m" for limb, length in stature.limbs_m.items())
    problem = f"the person is {stature.stature_m:.3g} m tall by these keypoints ({limbs})"
    if better_unit is None and SHORTEST_M <= stature.stature_m <= TALLEST_M:
        return [f"--height {height_m:g}: {problem}: check the height, and the unit of the calibration."]
    expected = f"{SHORTEST_M:g} to {TALLEST_M:g} m" if height_m is None else f"{height_m:g} m, as --height says"
    raise input_error("stature", problem, expected, _remedy(stature.stature_m, better_unit, unit))


def _better_unit(stature_m: float, height_m: float | None, unit: str | None) -> str | None:
    """The unit in which the person is nearest to the given height, or the usual one, if it is near enough."""
    if unit is None:
        return None
    statures = {name: stature_m * metres / METRES[unit] for name, metres in METRES.items() if name != unit}
    goal_m = height_m or USUAL_M
    best = min(statures, key=lambda name: abs(np.log(statures[name] / goal_m)))
    nearest, farthest = (SHORTEST_M, TALLEST_M) if height_m is None else (height_m / LARGEST_CONTRADICTION, height_m * LARGEST_CONTRADICTION)
    return best if nearest <= statures[best] <= farthest else None


def _remedy(stature_m: float, better_unit: str | None, unit: str | None) -> str:
    if better_unit is not None and unit is not None:
        baby = "; if it is a baby, give --height" if SHORTEST_BABY_M <= stature_m < SHORTEST_M else ""
        return f"with --unit {better_unit} it would be {stature_m * METRES[better_unit] / METRES[unit]:.3g} m{baby}"
    if unit is not None:
        board = "its translations may be in squares of a board, and are then to be multiplied by their side"
        return f"no unit makes it a person: name the calibration of this recording; {board}"
    return "name the calibration of this recording, or one in the unit that its maker writes"
