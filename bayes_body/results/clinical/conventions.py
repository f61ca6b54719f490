r"""The conventions of joint angles: of which segments, about which axes, in which order, and which movement is positive.

The axes of a segment are those of the International Society of Biomechanics: x forward, y up, z to the person's right (Wu et al. 2002, 2005).
Three rotations in sequence turn the proximal segment, with the rotation $R_p$ in the world, into the distal one:
$R_p^T R_d = R_a(\alpha) R_b(\beta) R_c(\gamma)$. The first axis belongs to the proximal segment and the third to the distal one. The second floats:
it is perpendicular to both. The sequence Z, X, Y is that of Grood & Suntay 1983.

On the left side the rotation is mirrored at the sagittal plane first, $R \to M R M$ with M = diag(1, 1, -1): the same number is the same movement.
"""

import warnings
from collections.abc import Iterable
from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from bayes_body.base.geometry import rotations

Side = Literal["r", "l", ""]
SIDES: tuple[Side, ...] = ("r", "l")
MIRROR = np.diag([1.0, 1.0, -1.0])
LABORATORY = "laboratory"


class Angle(NamedTuple):
    """One angle of a joint.

    Attributes:
        name: its name, without a side.
        positive: the movement to which positive values belong.
        negative: the movement to which negative values belong.
        opensim: the coordinate of OpenSim's models with the same meaning and sign, without a side; empty if there is none.
    """

    name: str
    positive: str
    negative: str
    opensim: str = ""


class Convention(NamedTuple):
    """The angles of one joint.

    Attributes:
        joint: the joint, as a reader calls it.
        proximal: the proximal segment, without a side; `LABORATORY` is the world.
        distal: the distal segment, without a side.
        sided: whether there is one on the right and one on the left.
        sequence: axes of the rotations, in order, such as `ZXY`.
        signs: factors of the three rotations.
        angles: the angles, in the order of the sequence.
        source: the publication.
        tilt_deg: how far the x axis of the rotations is turned upwards and inwards from the segments' x axis, degrees.
    """

    joint: str
    proximal: str
    distal: str
    sided: bool
    sequence: Literal["ZXY", "YXZ", "YXY"]
    signs: tuple[int, int, int]
    angles: tuple[Angle, Angle, Angle]
    source: str
    tilt_deg: tuple[float, float] = (0.0, 0.0)

    @property
    def axes(self) -> Float[np.ndarray, "3 3"]:
        """The rotation from the axes of the rotations to those of the segments, on the right side."""
        upwards, inwards = self.tilt_deg
        return Rotation.from_euler("YZ", [inwards, upwards], degrees=True).as_matrix()

    @property
    def sides(self) -> tuple[Side, ...]:
        """The sides on which the joint exists; `("",)` in the middle of the body."""
        return SIDES if self.sided else ("",)

    def segments(self, side: Side) -> tuple[str, str]:
        """Return the proximal and the distal segment of a side, as a body file names them; the trunk has no side."""
        proximal, distal = (name if name in MIDDLE or not side else f"{side}_{name}" for name in (self.proximal, self.distal))
        return proximal, distal

    def names(self, side: Side) -> tuple[str, str, str]:
        """Return the names of a side's angles, such as `knee_flexion_r`."""
        return _three(_of_side(angle.name, side) for angle in self.angles)

    def coordinates(self, side: Side) -> tuple[str, str, str]:
        """Return OpenSim's names of a side's angles, empty where there is none."""
        return _three(angle.opensim and _of_side(angle.opensim, side) for angle in self.angles)


MIDDLE = (LABORATORY, "pelvis", "thorax", "head")

PELVIS = Convention(
    *("pelvis in the laboratory", LABORATORY, "pelvis", False, "YXZ", (1, -1, -1)),
    (
        Angle("pelvic_rotation", "turned to the left", "turned to the right"),
        Angle("pelvic_obliquity", "right side up", "right side down"),
        Angle("pelvic_tilt", "anterior tilt", "posterior tilt"),
    ),
    "Baker 2001: the tilt does not depend on the direction in which the person walks",
)
TRUNK_SOURCE = "Wu et al. 2002, spine; signs of OpenSim"
LUMBAR = Convention(
    *("thorax on the pelvis", "pelvis", "thorax", False, "ZXY", (1, 1, 1)),
    (
        Angle("lumbar_extension", "extension", "flexion", "lumbar_extension"),
        Angle("lumbar_bending", "to the right", "to the left", "lumbar_bending"),
        Angle("lumbar_rotation", "to the left", "to the right", "lumbar_rotation"),
    ),
    TRUNK_SOURCE,
)
NECK = Convention(
    *("head on the thorax", "thorax", "head", False, "ZXY", (1, 1, 1)),
    (
        Angle("neck_extension", "extension", "flexion"),
        Angle("neck_bending", "to the right", "to the left"),
        Angle("neck_rotation", "to the left", "to the right"),
    ),
    TRUNK_SOURCE,
)
HIP = Convention(
    *("hip", "pelvis", "thigh", True, "ZXY", (1, 1, 1)),
    (
        Angle("hip_flexion", "flexion", "extension", "hip_flexion"),
        Angle("hip_adduction", "adduction", "abduction", "hip_adduction"),
        Angle("hip_rotation", "internal rotation", "external rotation", "hip_rotation"),
    ),
    "Wu et al. 2002",
)
KNEE = Convention(
    *("knee", "thigh", "shank", True, "ZXY", (-1, 1, 1)),
    (
        Angle("knee_flexion", "flexion", "extension", "knee_angle"),
        Angle("knee_adduction", "adduction (varus)", "abduction (valgus)"),
        Angle("knee_rotation", "internal rotation", "external rotation"),
    ),
    "Grood & Suntay 1983",
)
ANKLE = Convention(
    *("ankle", "shank", "foot", True, "ZXY", (1, 1, 1)),
    (
        Angle("ankle_dorsiflexion", "dorsiflexion", "plantarflexion", "ankle_angle"),
        Angle("ankle_inversion", "inversion", "eversion"),
        Angle("ankle_rotation", "internal rotation", "external rotation"),
    ),
    "Wu et al. 2002",
)
SHOULDER = Convention(
    *("shoulder", "thorax", "upper_arm", True, "YXY", (1, -1, 1)),
    (
        Angle("shoulder_plane", "in front of the frontal plane (90: forward)", "behind it"),
        Angle("shoulder_elevation", "elevation (0: the arm hangs)", "never"),
        Angle("shoulder_rotation", "internal rotation", "external rotation"),
    ),
    "Wu et al. 2005, thoracohumeral",
)
ARM = Convention(
    *("arm on the thorax", "thorax", "upper_arm", True, "ZXY", (1, 1, 1)),
    (
        Angle("arm_flexion", "flexion", "extension", "arm_flex"),
        Angle("arm_adduction", "adduction", "abduction", "arm_add"),
        Angle("arm_rotation", "internal rotation", "external rotation", "arm_rot"),
    ),
    "OpenSim (Rajagopal et al. 2016)",
)
ELBOW = Convention(
    *("elbow", "upper_arm", "forearm", True, "ZXY", (1, 1, 1)),
    (
        Angle("elbow_flexion", "flexion", "hyperextension", "elbow_flex"),
        Angle("elbow_adduction", "varus", "valgus (carrying angle)"),
        Angle("forearm_pronation", "pronation", "supination", "pro_sup"),
    ),
    "Wu et al. 2005",
)
WRIST = Convention(
    *("wrist", "forearm", "hand", True, "ZXY", (1, 1, 1)),
    (
        Angle("wrist_flexion", "flexion", "extension", "wrist_flex"),
        Angle("wrist_deviation", "ulnar deviation", "radial deviation"),
        Angle("wrist_rotation", "internal rotation", "external rotation"),
    ),
    "Wu et al. 2005",
)
CLINICAL = (PELVIS, LUMBAR, NECK, HIP, KNEE, ANKLE, SHOULDER, ARM, ELBOW, WRIST)

# How OpenSim's models place the pelvis in the ground: another order than Baker's, so that the tilt depends on the direction of the walk.
GROUND = Convention(
    *("pelvis in OpenSim's ground", LABORATORY, "pelvis", False, "ZXY", (1, 1, 1)),
    (
        Angle("pelvis_tilt", "posterior tilt", "anterior tilt", "pelvis_tilt"),
        Angle("pelvis_list", "right side down", "right side up", "pelvis_list"),
        Angle("pelvis_rotation", "turned to the left", "turned to the right", "pelvis_rotation"),
    ),
    "OpenSim",
)
TALOCRURAL = Convention(
    *("ankle of OpenSim", "shank", "talus", True, "ZXY", (1, 1, 1)),
    (
        Angle("talocrural_dorsiflexion", "dorsiflexion", "plantarflexion", "ankle_angle"),
        Angle("talocrural_inversion", "inversion", "eversion"),
        Angle("talocrural_rotation", "internal rotation", "external rotation"),
    ),
    "OpenSim",
)
SUBTALAR = Convention(
    *("subtalar joint of OpenSim", "talus", "foot", True, "ZXY", (1, 1, 1)),
    (
        Angle("subtalar_dorsiflexion", "dorsiflexion", "plantarflexion"),
        Angle("subtalar_inversion", "inversion", "eversion", "subtalar_angle"),
        Angle("subtalar_rotation", "internal rotation", "external rotation"),
    ),
    "OpenSim (gait2392, Delp et al. 1990)",
    (37.2, 8.7),
)
OPENSIM = (GROUND, *CLINICAL)
# For bodies with a talus: two joints in place of one between shank and foot.
OPENSIM_WITH_TALUS = (*OPENSIM[: OPENSIM.index(ANKLE)], TALOCRURAL, SUBTALAR, *OPENSIM[OPENSIM.index(ANKLE) + 1 :])


def opensim_conventions(segments: Iterable[str]) -> tuple[Convention, ...]:
    """Return the conventions of OpenSim's coordinates for a body with these segments."""
    return OPENSIM if {"r_talus", "l_talus"}.isdisjoint(segments) else OPENSIM_WITH_TALUS


def angles_of(convention: Convention, side: Side, R: Float[np.ndarray, "*batch 3 3"]) -> Float[np.ndarray, "*batch 3"]:
    """Return the angles of a joint, radians.

    The second is within a quarter turn of zero, or for `YXY` from 0 to half a turn; the others are within half a turn. At gimbal lock the first and
    the third axis are parallel, and only the sum or the difference of their angles is determined: the third is set to 0 (half a turn for `YXY`).

    Args:
        convention: the convention.
        side: the side of the joint.
        R: rotation from the distal segment to the proximal one.
    """
    with warnings.catch_warnings():
        # At gimbal lock the angles that are returned still reproduce the rotation.
        warnings.filterwarnings("ignore", message="Gimbal lock")
        # By quaternions, real part last: SciPy would make each matrix orthogonal by a singular value decomposition, which takes ten times as long.
        quaternions = np.roll(rotations.from_matrix(_to_axes(convention, side, R).reshape(-1, 3, 3)), -1, axis=-1)
        angles = Rotation.from_quat(quaternions).as_euler(convention.sequence)
    if convention.sequence == "YXY":
        # SciPy's second angle is positive, but raising the arm is a negative rotation about x.
        angles = _wrapped(angles * (1, -1, 1) + (np.pi, 0, np.pi))
    return (angles * convention.signs).reshape(*R.shape[:-2], 3)


def rotation_of(convention: Convention, side: Side, angles: Float[np.ndarray, "*batch 3"]) -> Float[np.ndarray, "*batch 3 3"]:
    """Return the rotation from the distal segment to the proximal one of a joint with these angles, radians."""
    turns = (angles * convention.signs).reshape(-1, 3)
    R = Rotation.from_euler(convention.sequence, turns).as_matrix().reshape(*angles.shape[:-1], 3, 3)
    return _mirrored(side, convention.axes @ R @ convention.axes.T)


def _to_axes(convention: Convention, side: Side, R: Float[np.ndarray, "*batch 3 3"]) -> Float[np.ndarray, "*batch 3 3"]:
    """Return a joint's rotation about the axes of the convention, mirrored on the left side."""
    mirrored = _mirrored(side, R)
    return convention.axes.T @ mirrored @ convention.axes if any(convention.tilt_deg) else mirrored


def _mirrored(side: Side, R: Float[np.ndarray, "*batch 3 3"]) -> Float[np.ndarray, "*batch 3 3"]:
    return MIRROR @ R @ MIRROR if side == "l" else R


def _wrapped(angles: Float[np.ndarray, "*batch 3"]) -> Float[np.ndarray, "*batch 3"]:
    return np.pi - np.mod(np.pi - angles, 2 * np.pi)


def _three(names: Iterable[str]) -> tuple[str, str, str]:
    first, second, third = names
    return first, second, third


def _of_side(name: str, side: Side) -> str:
    return f"{name}_{side}" if side else name
