r"""A person's joint centres under the same names, whatever the file format.

Pelvis and thorax are the midpoints of the hips and of the shoulders, unless a file has the fifteen markers under this project's names. Head is the
crown. Skeletons of the CMU database end at eye height, 0.064 of the height H below the crown (Drillis & Contini 1966: 0.936 H). With thigh and shank
together 0.491 H (0.245 + 0.246), the crown is $0.13\,(thigh + shank)$ further along the head's bone.

A table of the names of joints in motion capture files tells which of a file's names mean which landmark.
"""

import re
from collections.abc import Iterator, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from bayes_body.base.errors import input_error, nearest
from bayes_body.recording.evidence.markers import MARKERS
from bayes_body.recording.readers.mocap.motion import Motion

# The landmarks among MARKERS that are looked up by name; pelvis and thorax are the midpoints of the hips and of the shoulders.
LIMBS = ("hip", "knee", "ankle", "shoulder", "elbow", "wrist")
SOUGHT = (*(f"{side}_{limb}" for side in "lr" for limb in LIMBS), "head")
# Names of characters and subjects that programs put before each joint name.
PREFIX = re.compile(r"^(mixamorig\d*|bip\d+|character\d*)[_ ]*", re.IGNORECASE)
# How a side is written: before or after the joint name.
SIDES = ("{side}{name}", "{initial}{name}", "{name}{side}", "{name}{initial}")


class Dialect(NamedTuple):
    """Names in lower case, without separators, sides and prefixes. If a landmark has several names, the first one in the file is used.

    Attributes:
        title: for messages.
        sided: names of landmarks with a left and a right side.
        middle: names of all others.
        head_is_low: whether the head's bone ends at eye height instead of the crown.
    """

    title: str
    sided: Mapping[str, tuple[str, ...]]
    middle: Mapping[str, tuple[str, ...]]
    head_is_low: bool = False


DIALECTS = (
    Dialect(
        "marker names (l_hip, LHip, LeftHip; Pose2Sim, OpenSim, SMPL, Biovision)",
        {limb: (limb,) for limb in LIMBS}
        | {"toe": ("toeend", "bigtoe", "toe", "foot", "ankleend"), "heel": ("heel", "calc"), "hand": ("handend", "hand", "wristend")},
        {"head": ("headtopend", "headend", "head"), "neck": ("neck",)},
    ),
    Dialect(
        "joints of a body (exports of bayes-body)",
        {"hip": ("hip",), "knee": ("knee",), "ankle": ("kneeend",), "shoulder": ("shoulder",), "elbow": ("elbow",), "wrist": ("elbowend",)},
        {"head": ("headend",)},
    ),
    Dialect(
        "CMU asf (lfemur, ltibia)",
        {
            **{"hip": ("femur",), "knee": ("tibia",), "ankle": ("foot",), "toe": ("toesend",)},
            # `wrist` in these skeletons is a joint inside the forearm that only rotates about the forearm's axis; the hand bends where `hand` starts.
            **{"shoulder": ("humerus",), "elbow": ("radius",), "wrist": ("hand",), "hand": ("fingersend",)},
        },
        {"head": ("headend",), "neck": ("upperneck",)},
        head_is_low=True,
    ),
    Dialect(
        "CMU bvh (LeftUpLeg, LeftFingerBase)",
        {
            **{"hip": ("upleg",), "knee": ("leg",), "ankle": ("foot",), "toe": ("toebaseend",)},
            **{"shoulder": ("arm",), "elbow": ("forearm",), "wrist": ("fingerbase",), "hand": ("handindex1end",)},
        },
        {"head": ("headend",), "neck": ("neck1",)},
        head_is_low=True,
    ),
    Dialect(
        "character bvh (LeftUpLeg, mixamorig:LeftUpLeg, thigh.L)",
        {
            "hip": ("upleg", "upperleg", "thigh"),
            "knee": ("lowleg", "lowerleg", "leg", "shin", "calf"),
            "ankle": ("foot", "ankle"),
            "toe": ("toeend", "toebaseend", "toetipend", "toe0end", "toe", "toebase", "footend"),
            "heel": ("heel",),
            "shoulder": ("uparm", "upperarm", "arm"),
            "elbow": ("forearm", "lowarm", "lowerarm"),
            "wrist": ("hand", "wrist"),
            "hand": ("handmiddle4end", "handmiddle4", "handmiddle3end", "handmiddle3", "handmiddle1", "handend"),
        },
        {"head": ("headtopend", "headend", "headtop", "head"), "neck": ("neck",)},
    ),
)


class Reading(NamedTuple):
    """A dialect, and the file's name for each landmark that the file has in this dialect."""

    dialect: Dialect
    joints: dict[str, str]

    @property
    def missing(self) -> tuple[str, ...]:
        """Those of the fifteen markers that cannot be derived."""
        return tuple(name for name in SOUGHT if name not in self.joints)


def best_reading(joints: Sequence[str]) -> Reading:
    """The dialect that recognises most of the fifteen markers in a file."""
    spelled: dict[str, str] = {}
    for joint in joints:
        spelled.setdefault(plain(joint), joint)
    readings = [Reading(dialect, joints) for dialect in DIALECTS for joints in _in_dialect(dialect, spelled)]
    # On a tie the first in the table wins.
    return min(readings, key=lambda reading: len(reading.missing))


def plain(name: str) -> str:
    """A joint name in lower case, without prefixes and separators: `mixamorig:LeftUpLeg` is `leftupleg`."""
    return re.sub(r"[\s_.-]+", "", PREFIX.sub("", name.rpartition(":")[2])).lower()


def _in_dialect(dialect: Dialect, spelled: Mapping[str, str]) -> Iterator[dict[str, str]]:
    """One reading for each way to write the sides."""
    middle = {landmark: spelled[name] for landmark, name in _present(dialect.middle, spelled, "{name}", "").items()}
    for form in SIDES:
        reading = dict(middle)
        for side in ("left", "right"):
            for part, name in _present(dialect.sided, spelled, form, side).items():
                reading[f"{side[0]}_{part}"] = spelled[name]
        yield reading


def _present(wanted: Mapping[str, tuple[str, ...]], spelled: Mapping[str, str], form: str, side: str) -> dict[str, str]:
    out = {}
    for landmark, names in wanted.items():
        formed = [form.format(name=_inner(name, form), side=side, initial=side[:1]) + _outer(name, form) for name in names]
        spelling = next((name for name in formed if name in spelled), None)
        if spelling is not None:
            out[landmark] = spelling
    return out


def _inner(name: str, form: str) -> str:
    """The name before the side: the end of `thigh.L` is `thigh.L_end`."""
    return name.removesuffix("end") if form.startswith("{name}") else name


def _outer(name: str, form: str) -> str:
    return "end" if form.startswith("{name}") and name.endswith("end") else ""


def known_markers(joints: Sequence[str]) -> bool:
    """Whether a file names the fifteen markers as this project does."""
    return set(MARKERS) <= set(joints)


BEYOND_EYES = 0.13
EXTRA = ("l_toe", "r_toe", "l_heel", "r_heel", "l_hand", "r_hand", "neck")
LISTED = 60

type Places = dict[str, Float[np.ndarray, "frame 3"]]


def landmarks(motion: Motion, names: Mapping[str, str] | None = None) -> Places:
    """Positions (frame, 3) in metres, z up, NaN where unknown: the fifteen of `MARKERS`, and those of `EXTRA` that the file has.

    Args:
        motion: its joints have names of one of `dialects.DIALECTS`.
        names: the joint or marker for a landmark, if the file uses other names. Landmarks not given here are looked up.

    Raises:
        InputError: `names` has an unknown landmark or a joint that the motion lacks; or some of the fifteen cannot be found.
    """
    overrides = dict(names or {})
    _check_names(motion, overrides)
    reading = best_reading(motion.joints)
    joints = {name: name for name in (*MARKERS, *EXTRA) if name in motion.joints} if known_markers(motion.joints) else reading.joints
    reading = Reading(reading.dialect, joints | overrides)
    if reading.missing:
        raise _missing_joints_error(motion, reading)
    places = {landmark: motion.positions_m[:, motion.joints.index(joint)] for landmark, joint in reading.joints.items()}
    if reading.dialect.head_is_low and "head" not in overrides:
        places["head"] = _crown(motion, reading, places)
    for middle, side in (("pelvis", "hip"), ("thorax", "shoulder")):
        places.setdefault(middle, (places[f"l_{side}"] + places[f"r_{side}"]) / 2)
    return {name: places[name] for name in (*MARKERS, *EXTRA) if name in places}


def _check_names(motion: Motion, names: Mapping[str, str]) -> None:
    for landmark, joint in names.items():
        if landmark not in (*MARKERS, *EXTRA):
            raise input_error("names", f"'{landmark}'", "landmarks", nearest(landmark, (*MARKERS, *EXTRA)))
        if joint not in motion.joints:
            raise input_error(
                f"names: {landmark}", f"'{joint}', which {motion.name} lacks", "one of its joints or markers", nearest(joint, motion.joints)
            )


def _missing_joints_error(motion: Motion, reading: Reading) -> Exception:
    listing = f"{len(motion.joints)} names ({', '.join(motion.joints[:LISTED])}{', ...' if len(motion.joints) > LISTED else ''})"
    dialects = "; ".join(dialect.title for dialect in DIALECTS)
    missing = ", ".join(reading.missing)
    return input_error(
        motion.name, f"no {missing} among its {listing}", f"the names of one of: {dialects}", f"give the joints for {missing} with names"
    )


def _crown(motion: Motion, reading: Reading, places: Places) -> Float[np.ndarray, "frame 3"]:
    """The crown: beyond the end of the head's bone, which is at eye height."""
    end = motion.joints.index(reading.joints["head"])
    bone = motion.positions_m[:, end] - motion.positions_m[:, motion.parents[end]]
    return places["head"] + BEYOND_EYES * _leg(places) * bone / np.linalg.norm(bone, axis=-1, keepdims=True).clip(1e-9)


def _leg(places: Places) -> float:
    """Length of thigh and shank together, mean of both legs."""
    bones = [places[f"{side}_{end}"] - places[f"{side}_{start}"] for side in "lr" for start, end in (("hip", "knee"), ("knee", "ankle"))]
    lengths = np.linalg.norm(bones, axis=-1).sum(axis=0) / 2
    return float(np.median(lengths))
