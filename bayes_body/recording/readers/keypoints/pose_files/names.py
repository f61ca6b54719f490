"""The names that people give to keypoints: `left_shoulder`, `LShoulder`, `shoulder_l` and others, as this project writes them: `l_shoulder`."""

import re
import unicodedata
from collections.abc import Sequence

SIDES = {"l": "l", "left": "l", "r": "r", "right": "r"}
# Words of a joint's name, joined.
JOINTS = {
    **{name: name for name in ("nose", "eye", "ear", "shoulder", "elbow", "wrist", "hip", "knee", "ankle", "heel", "head", "neck")},
    "bigtoe": "big_toe",
    "smalltoe": "small_toe",
    "littletoe": "small_toe",
    "toe": "big_toe",
    "hallux": "big_toe",
    "midhip": "mid_hip",
    "hips": "mid_hip",
    "pelvis": "mid_hip",
    "root": "mid_hip",
    "upperneck": "upper_neck",
    "thorax": "neck",
    "chest": "neck",
    "headtop": "head",
    "tophead": "head",
    "crown": "head",
    "foot": "big_toe",
    "calcaneus": "heel",
}
WORDS = re.compile(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+|\d+")


def keypoint_names(names: Sequence[str]) -> tuple[str, ...]:
    """Return this project's names. A name that is not known stays as it is, and so does one that would be there twice."""
    renamed = [_renamed(name) for name in names]
    return tuple(new if renamed.count(new) == 1 else name for name, new in zip(names, renamed, strict=True))


def _renamed(name: str) -> str:
    words = [word.lower() for word in WORDS.findall(unicodedata.normalize("NFKC", name))]
    sides = [SIDES[word] for word in words if word in SIDES]
    joined = "".join(word for word in words if word not in SIDES)
    if joined not in JOINTS and not sides and joined[:1] in SIDES and joined[1:] in JOINTS:
        # lshoulder
        sides, joined = [joined[0]], joined[1:]
    if joined not in JOINTS or len(sides) > 1:
        return name
    return f"{sides[0]}_{JOINTS[joined]}" if sides else JOINTS[joined]
