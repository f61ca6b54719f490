r"""Where a network sees a joint, against the joint's centre, as an unknown: the keypoint of marker m is expected at $x_m + R_m o_m$.

The offset $o_m$ is a vector in the frame of the marker's joint: that of a hip turns with the thigh. Only the likelihood sees it. Markers, angles and
walls stay at the joint's centre. So an offset that is determined moves the joint's centre away from the keypoint, as it should: networks see a hip
too far outside and above.

A session may give offsets and their standard deviations (`keypoint_offsets_m`, `keypoint_offsets_sd_m`): the offsets vary about these.

For a marker at the end of a bone, such as a wrist, an offset along the bone cannot be told from the bone's length. It is 0.
"""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from jaxtyping import Array, Float, Int

from bayes_body.base.errors import InputError, nearest
from bayes_body.base.geometry.namespaces import device_array
from bayes_body.base.registry import register
from bayes_body.base.toml.schema import Positive
from bayes_body.density.factor import Numbered, Variables
from bayes_body.model.body.build import build_body
from bayes_body.model.body.solids import Body
from bayes_body.model.unknowns.unknown import Setting, Unknown, UnknownSchema, centred, deviations, unknown_about_zero
from bayes_body.recording.evidence.markers import KEYPOINTS

NAME = "keypoint_offsets"
SD_M = {"*hip": 0.025, "pelvis": 0.025, "*shoulder": 0.02, "thorax": 0.02, "head": 0.03, "*": 0.015}
AXES = "xyz"


class Options(UnknownSchema):
    """Options of `[[unknown]] kind = "keypoint_offsets"`."""

    sd_m: Mapping[str, Positive] = {}
    """[metres] table: a marker's name or a pattern = the standard deviation along each axis; what is not named has 15 mm, shoulders and thorax 20 mm,
    hips and pelvis 25 mm, head 30 mm."""
    lasts_s: Positive = 2.0
    """[s] after this time an error has faded to 37 %. Errors of networks change with the posture."""


def change(places: Int[Array, "entry 2"], body: Body, value: Float[Array, " entry"], values: Variables) -> Body:
    """Return the body with its markers where keypoints are expected. `places` are the marker and the axis of each entry."""
    del values
    return replace(body, markers=replace(body.markers, offsets=body.markers.offsets.at[places[:, 0], places[:, 1]].add(value)))


@register("unknown", NAME, Options)
def build(options: Options, setting: Setting, **_: Any) -> Unknown:
    """Build the unknown for one body."""
    # The proportions of the body file: a subject's lengths, such as those of a fit, must not change which entries there are.
    names, bone_axes = setting.body.markers.names, _bones(build_body(setting.body.name, setting.schema))
    places = [(m, axis) for m, name in enumerate(names) if name in KEYPOINTS for axis in range(3) if bone_axes[m] != axis]
    sd = deviations(options.sd_m, SD_M, tuple(names[m] for m, _ in places), "unknown 'keypoint_offsets': sd_m", "marker")
    labels = tuple(f"{names[m]}_{AXES[axis]}" for m, axis in places)
    index = device_array(np.array(places, np.int32), np.int32)
    mean_m, sd_m = setting.subject.keypoint_offsets_m, setting.subject.keypoint_offsets_sd_m
    for key in (*mean_m, *sd_m):
        if key not in names:
            raise InputError(f"session.toml: subject: keypoint offset of '{key}': no such marker of the body; {nearest(key, names)}")
    unsaid = (0.0, 0.0, 0.0)
    sd = [sd_m.get(names[m], unsaid)[axis] or usual for (m, axis), usual in zip(places, sd, strict=True)]
    attributes = {"sides": ("likelihood",), "moves": Numbered("marker", tuple(m for m, _ in places))}
    offsets = unknown_about_zero(NAME, labels, ("m",) * len(sd), sd, options.lasts_s, setting, Body, change, index, **attributes)
    return centred(offsets, [mean_m.get(names[m], unsaid)[axis] for m, axis in places])


def _bones(body: Body) -> list[int | None]:
    """Return, for each marker at the end of a bone, the axis of its joint's frame that is nearest to the bone; None for a joint that moves."""
    topology, axes = body.skeleton.topology, list[int | None]()
    presets, offsets = np.asarray(body.skeleton.presets, float), np.asarray(body.skeleton.offsets, float)
    for joint, offset in zip(body.markers.joints, np.asarray(body.markers.offsets, float), strict=True):
        if not offset.any() and not topology.motions[joint]:
            # The marker of a joint that does not move, such as the wrist of a hand that does not bend.
            offset = presets[joint].T @ offsets[joint]
        axes.append(int(np.abs(offset).argmax()) if offset.any() else None)
    return axes
