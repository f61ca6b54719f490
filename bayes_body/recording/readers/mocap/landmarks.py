r"""A person's joint centres under the same names, whatever the file format.

Pelvis and thorax are the midpoints of the hips and of the shoulders, unless a file has the fifteen markers under this project's names. Head is the
crown. Skeletons of the CMU database end at eye height, 0.064 of the height H below the crown (Drillis & Contini 1966: 0.936 H). With thigh and shank
together 0.491 H (0.245 + 0.246), the crown is $0.13\,(thigh + shank)$ further along the head's bone.
"""

from collections.abc import Mapping

import numpy as np
from jaxtyping import Float

from bayes_body.base.errors import input_error, nearest
from bayes_body.recording.evidence.markers import MARKERS
from bayes_body.recording.readers.mocap.dialects import DIALECTS, Reading, best_reading, known_markers
from bayes_body.recording.readers.mocap.motion import Motion

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
        raise _unknown(motion, reading)
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


def _unknown(motion: Motion, reading: Reading) -> Exception:
    listing = f"{len(motion.joints)} names ({', '.join(motion.joints[:LISTED])}{', ...' if len(motion.joints) > LISTED else ''})"
    known = "; ".join(dialect.title for dialect in DIALECTS)
    missing = ", ".join(reading.missing)
    return input_error(motion.name, f"no {missing} among its {listing}", f"the names of one of: {known}", f"give the joints for {missing} with names")


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
