r"""The subject of a PARSEC bodytrack folder: body shape, first pose and motion, with the names of the body `deutscher_31`.

Two facts about the format's pose:

**Hinge angles are made negative (or 0).** A limb of two parts with circular sections looks the same when its upper joint's twist turns by $\pi$ and
its hinge changes sign, $R_z(\pi) R_y(\theta) = R_y(-\theta) R_z(\pi)$: the last rotation only spins the lower part about its own axis. The files use
both forms. Flexion is negative in the format's own limits, and in `deutscher_31`.

**The limits of PoseParameters.txt are not used.** They belong to the other form of some poses and exclude the initial pose, so they cannot be the
support of a prior. The limits of the body apply.
"""

import math
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from bayes_body.base.errors import input_error
from bayes_body.recording.readers.faults import Faults
from bayes_body.recording.readers.parsec_files import MM, read_numbers
from bayes_body.recording.session.session import Subject

BODY = "deutscher_31"
POSITIONS = ("root_x", "root_y", "root_z")
# The order of InitialPose.txt and of each third of PoseParameters.txt.
DOFS = (
    *("root_roll", "root_pitch", "root_yaw", *POSITIONS),
    *("l_hip_x", "l_hip_y", "l_hip_z", "l_knee", "r_hip_x", "r_hip_y", "r_hip_z", "r_knee"),
    *("l_clavicle_x", "l_clavicle_y", "l_shoulder_x", "l_shoulder_y", "l_shoulder_z", "l_elbow"),
    *("r_clavicle_x", "r_clavicle_y", "r_shoulder_x", "r_shoulder_y", "r_shoulder_z", "r_elbow"),
    *("thorax_y", "thorax_z", "head_x", "head_y", "head_z"),
)
# The order of BodyShapeParameters.txt: four numbers per part, then 18 lengths, some of which have no meaning for this body.
PARTS = ("torso", "l_thigh", "l_calf", "r_thigh", "r_calf", "l_upper_arm", "l_forearm", "r_upper_arm", "r_forearm", "head")
LENGTHS = (
    *("torso", "l_pelvis", "l_thigh", "l_calf", None, "r_pelvis", "r_thigh", "r_calf", None),
    *("l_clavicle", "l_upper_arm", "l_forearm", None, "r_clavicle", "r_upper_arm", "r_forearm", None, "head"),
)
# Hinge, twist of the joint above it, and the two parts whose sections must be circular.
LIMBS = tuple(
    (f"{side}_{hinge}", f"{side}_{joint}_z", (f"{side}_{upper}", f"{side}_{lower}"))
    for side in "lr"
    for hinge, joint, upper, lower in (("knee", "hip", "thigh", "calf"), ("elbow", "shoulder", "upper_arm", "forearm"))
)
SHAPE_COLUMNS = ("base radius", "tip radius", "x-scale", "y-scale")
# If the longest length, read as millimetres, is below this, the file is in metres.
SHORTEST_MM = 3.0


class Known(NamedTuple):
    """The subject, the first pose by dof (radians, metres), and remarks for the user."""

    subject: Subject
    initial: dict[str, float]
    remarks: list[str]


def read_subject(source: Path) -> Known:
    """The subject of a folder.

    Raises:
        FaultyFileError: one sentence for each fault in the three files.
    """
    faults = Faults()
    shape, pose, motion = Subject(), {}, np.empty((3, len(DOFS)))
    with faults.collect():
        shape = _read_shape(source / "BodyShapeParameters.txt")
    with faults.collect():
        pose = _by_dof(read_numbers(source / "InitialPose.txt", 31, "angles in radians, the root's position in mm"))
    with faults.collect():
        motion = _read_motion(source / "PoseParameters.txt")
    faults.raise_any()
    initial, remarks = canonical_hinges(pose, shape.sections)
    subject = Subject(BODY, None, shape.lengths_m, shape.radii_m, shape.sections, _by_dof(motion[0]))
    return Known(subject, initial, [*remarks, _limits_remark(initial, *motion[1:])])


def _by_dof(numbers: NDArray[np.float64]) -> dict[str, float]:
    return {dof: float(value) * (MM if dof in POSITIONS else 1.0) for dof, value in zip(DOFS, numbers, strict=True)}


def _read_shape(path: Path) -> Subject:
    numbers = read_numbers(path, 58, "10 parts of 4 (base radius, tip radius, x-scale, y-scale), then 18 lengths")
    rows, lengths = numbers[:40].reshape(10, 4), numbers[40:]
    measures = {f"{part}, {column}": value for part, row in zip(PARTS, rows, strict=True) for column, value in zip(SHAPE_COLUMNS, row, strict=True)}
    named = {name: float(value) for name, value in zip(LENGTHS, lengths, strict=True) if name}
    _check_positive(path, measures | {f"{name}, length": value for name, value in named.items()})
    if max(named.values()) < SHORTEST_MM:
        raise input_error(
            path, f"the longest length is {max(named.values()):g} mm", "millimetres", "it looks like metres: multiply radii and lengths by 1000"
        )
    return Subject(
        lengths_m={name: value * MM for name, value in named.items()},
        radii_m={part: (float(row[0]) * MM, float(row[1]) * MM) for part, row in zip(PARTS, rows, strict=True)},
        sections={part: (float(row[2]), float(row[3])) for part, row in zip(PARTS, rows, strict=True)},
    )


def _read_motion(path: Path) -> NDArray[np.float64]:
    """Standard deviations, minima and maxima, (3, 31), in the file's units."""
    motion = read_numbers(path, 93, "31 standard deviations per frame, 31 minima, 31 maxima").reshape(3, -1)
    _check_positive(path, {f"{dof}, standard deviation": value for dof, value in zip(DOFS, motion[0], strict=True)})
    return motion


def _check_positive(path: Path, values: Mapping[str, float]) -> None:
    faults = Faults()
    for name, value in values.items():
        with faults.collect():
            if value <= 0:
                raise input_error(path, f"{name} = {value:g}", "a positive number", "correct it, or restore the file from the recording")
    faults.raise_any()


def canonical_hinges(pose: Mapping[str, float], sections: Mapping[str, tuple[float, float]]) -> tuple[dict[str, float], list[str]]:
    """The same pose in the image with every knee and elbow at most 0 (see the module), and a remark for each limb that changed.

    Args:
        pose: by dof, radians (and metres).
        sections: (x, y) scale factors of each part; limbs without circular sections stay as they are.
    """
    pose, remarks = dict(pose), []
    for hinge, twist, parts in LIMBS:
        if pose[hinge] <= 0 or not all(math.isclose(*sections[part]) for part in parts):
            continue
        given_angles = pose[hinge], pose[twist]
        # Of the two equivalent rotations, take the twist nearer to 0: the limits surround 0.
        pose[twist] = min(pose[twist] - math.pi, pose[twist] + math.pi, key=abs)
        pose[hinge] = -pose[hinge]
        (h0, t0), (h1, t1) = (tuple(math.degrees(angle) for angle in pair) for pair in (given_angles, (pose[hinge], pose[twist])))
        remarks.append(
            f"InitialPose.txt: {hinge} {h0:.1f} deg becomes {h1:.1f}, {twist} {t0:.1f} becomes {t1:.1f}: the same picture with negative flexion."
        )
    return pose, remarks


def _limits_remark(initial: Mapping[str, float], low: NDArray[np.float64], high: NDArray[np.float64]) -> str:
    lows, highs = _by_dof(low), _by_dof(high)
    outside = sum(not lows[dof] <= initial[dof] <= highs[dof] for dof in DOFS)
    reason = f"exclude the initial pose in {outside} of {len(DOFS)} angles" if outside else "are tuned to this recording"
    return f"PoseParameters.txt: its limits {reason}; they are ignored, and the limits of the body {BODY} apply."
