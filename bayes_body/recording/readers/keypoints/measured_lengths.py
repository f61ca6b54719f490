"""The subject's limbs, measured on triangulated keypoints of many frames.

A limb's length is the median, over frames and both sides, of the distance between its triangulated joints. Only limbs are measured: a network's hips
and shoulders lie beside the joints' centres, so that the widths of pelvis and shoulders are printed, and not used.
"""

from collections.abc import Mapping
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from bayes_body.recording.readers.agreement.cameras import common_keypoints, spread_frames
from bayes_body.recording.readers.keypoints.triangulate import triangulate
from bayes_body.recording.session.session import Session

# The body that has these names, and all bodies that are `measured_as` it.
BODY = "deutscher_31"
LIMBS = {"thigh": ("hip", "knee"), "calf": ("knee", "ankle"), "upper_arm": ("shoulder", "elbow"), "forearm": ("elbow", "wrist")}
WIDTHS = {"hips": ("l_hip", "r_hip"), "shoulders": ("l_shoulder", "r_shoulder")}
# Of fewer frames the median is uncertain; a larger spread (standard deviation over length) is no limb but error.
FEWEST_FRAMES, LARGEST_SPREAD = 20, 0.15
# A median absolute deviation in standard deviations of a normal distribution.
MAD_TO_SD = 1.4826


class Measure(NamedTuple):
    """A distance between two joints, metres: its median, and its standard deviation over frames (from the median absolute deviation)."""

    length_m: float
    sd_m: float


def measure_body(session: Session) -> tuple[Mapping[str, Measure], Mapping[str, Measure]]:
    """Measure the limbs and the widths of the subject, by name; what too few frames show, or too variably, is left out.

    Raises:
        InputError: a file of keypoints cannot be read.
    """
    cameras, names, keypoints = common_keypoints(session)
    pairs = {limb: [(f"{side}_{upper}", f"{side}_{lower}") for side in "lr"] for limb, (upper, lower) in LIMBS.items()}
    pairs |= {width: [ends] for width, ends in WIDTHS.items()}
    joints = [name for name in dict.fromkeys(end for ends in pairs.values() for pair in ends for end in pair) if name in names]
    if session.moves or len(cameras) < 2 or not joints:
        return {}, {}
    chosen = keypoints[:, :, [names.index(name) for name in joints]]
    chosen = chosen[:, spread_frames(chosen, 0)]
    points = triangulate(cameras, chosen.reshape(len(cameras), -1, 3)).points_m.reshape(-1, len(joints), 3)
    measures = {}
    for name, ends in pairs.items():
        sides = [pair for pair in ends if set(pair) <= set(joints)]
        lengths = [np.linalg.norm(points[:, joints.index(a)] - points[:, joints.index(b)], axis=-1) for a, b in sides]
        lengths = [side[np.isfinite(side)] for side in lengths]
        if lengths and min(map(len, lengths)) >= FEWEST_FRAMES:
            measure = _measure(np.concatenate(lengths))
            if measure.sd_m <= LARGEST_SPREAD * measure.length_m:
                measures[name] = measure
    return {name: measures[name] for name in LIMBS if name in measures}, {name: measures[name] for name in WIDTHS if name in measures}


def _measure(lengths: np.ndarray) -> Measure:
    median = float(np.median(lengths))
    return Measure(median, MAD_TO_SD * float(np.median(np.abs(lengths - median))))


def with_measured_lengths(session: Session) -> tuple[Session, list[str]]:
    """Return the session with the measured lengths of the subject's limbs, and a remark; unchanged if it has lengths, or nothing is measured.

    Raises:
        InputError: a file of keypoints cannot be read.
    """
    subject = session.subject
    if subject.lengths_m or subject.body not in (None, BODY):
        return session, []
    limbs, widths = measure_body(session)
    if not limbs:
        return session, []
    lengths = {f"{side}_{name}": round(measure.length_m, 3) for name, measure in limbs.items() for side in "lr"}
    limbs_text = ", ".join(f"{name.replace('_', ' ')} {measure.length_m:.3f} ({measure.sd_m:.3f})" for name, measure in limbs.items())
    remark = f"Lengths of the limbs are measured on the keypoints (m, standard deviation over frames): {limbs_text}; --no-lengths leaves them out."
    widths_text = ", ".join(f"{name} {measure.length_m:.3f}" for name, measure in widths.items())
    remarks = [remark, *([f"Distances between the keypoints, not used, m: {widths_text}."] if widths_text else [])]
    return replace(session, subject=replace(subject, body=BODY, lengths_m=lengths)), remarks
