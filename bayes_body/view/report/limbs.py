"""Readable names of dofs, and the limbs to which they belong."""

import re
from collections.abc import Mapping, Sequence

from bayes_body.base.errors import escaped

SIDES = {"l": "left", "r": "right"}
# Words in the names of joints. Joints with other names are grouped under OTHER.
LIMBS = {
    "leg": ("hip", "thigh", "knee", "shank", "calf", "ankle", "foot", "toe"),
    "arm": ("clavicle", "scapula", "shoulder", "upper_arm", "elbow", "forearm", "wrist", "hand"),
    "Trunk and head": ("pelvis", "spine", "lumbar", "torso", "thorax", "chest", "neck", "head"),
    "Position and orientation of the whole body": ("root",),
}
OTHER = "Other joints"


def by_limb(dofs: Sequence[str]) -> Mapping[str, list[int]]:
    """Return the indices of the dofs, grouped by limb. Limbs are in the order in which a reader expects them, dofs in that of the body."""
    groups: dict[str, list[int]] = {}
    for place, dof in enumerate(dofs):
        groups.setdefault(limb(dof), []).append(place)
    order = ("Left leg", "Right leg", "Leg", "Left arm", "Right arm", "Arm", *LIMBS, OTHER)
    return {name: groups[name] for name in order if name in groups}


def limb(dof: str) -> str:
    """Return the limb of a dof, such as `Left leg`."""
    side, joint = _side(dof)
    part = next((name for name, words in LIMBS.items() if any(word in joint for word in words)), OTHER)
    return f"{side} {part}".strip().capitalize() if part in ("leg", "arm") else part


def spoken(dof: str) -> str:
    """Return the readable name of a dof or part: `left hip y` for `l_hip_y`. It is one line, which a plot can show."""
    side, joint = _side(escaped(dof))
    return f"{side} {joint}".strip().replace("_", " ")


def _side(dof: str) -> tuple[str, str]:
    match = re.match(r"([lr])_(.+)", dof)
    return (SIDES[match[1]], match[2]) if match else ("", dof)
