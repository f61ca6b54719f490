"""A picture of a body's anatomical axes and of the positive directions of its clinical angles, for people who read them or write a body file.

The body stands upright with hanging arms, in which all angles are zero: each segment's axes (x forward, y up, z to the right) are those of the
laboratory. The left side mirrors the right one, so angles are drawn on the right.
"""

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from jaxtyping import Float

from bayes_body.base.errors import input_error
from bayes_body.base.files.atomic import replacing
from bayes_body.model.body.solids import Body
from bayes_body.model.body.tables import Segment
from bayes_body.results.clinical.conventions import LABORATORY
from bayes_body.results.clinical.joints import Joint, axes_of, joints_of
from bayes_body.view.colours import AXES, GREY, INK, SKIN

if TYPE_CHECKING:
    from matplotlib.axes import Axes

# The laboratory of the picture has the anatomical axes: x forward, y up, z to the right.
OWN = (0, 1, 2)
NAMES = ("x forward", "y up", "z to the right")
ARROW_M, ARC_M, LINE_M, WIDTH_M, PANEL_IN = 0.13, 0.075, 0.12, 1.3, 3.5
# Angles of the shoulder repeat those of the arm in another sequence, and have no arrow of their own.
LEFT_OUT = ("shoulder",)


class Panel(NamedTuple):
    """A view of the body.

    Attributes:
        title: what it shows.
        right: the direction of the picture's right, in the laboratory.
        up: that of the picture's top.
        axis: the axis of the rotations whose arrows are drawn, 0 to 2; None shows the axes of the segments.
    """

    title: str
    right: Float[np.ndarray, "3"]
    up: Float[np.ndarray, "3"]
    axis: int | None


X, Y, Z = np.eye(3)
PANELS = (
    Panel("Axes of the segments", -0.5 * X - 0.866 * Z, -0.208 * X + 0.97 * Y + 0.12 * Z, None),
    Panel("About z, seen from the right", X, Y, 2),
    Panel("About x, seen from the front", -Z, Y, 0),
    Panel("About y, seen from the front", -Z, Y, 1),
)


class Stance(NamedTuple):
    """The joints of the skeleton in the anatomical stance, in the laboratory."""

    rotations: Float[np.ndarray, "joint 3 3"]
    origins: Float[np.ndarray, "joint 3"]


def draw_axes(body: Body, segments: Mapping[str, Segment], path: Path) -> tuple[str, ...]:
    """Write the picture as .png, and return the names of the body's clinical angles.

    Args:
        body: the body.
        segments: the table `[clinical]` of its file.
        path: the file.

    Raises:
        InputError: the table is empty or names no joint that moves, or the file cannot be written.
    """
    from matplotlib.figure import Figure

    joints = joints_of(body, segments, OWN)
    if not joints:
        remedy = "add the axes of the segments on both sides of a joint"
        raise input_error(f"the body '{body.name}': [clinical]", "no joint with clinical angles", "at least one", remedy)
    stance = stance_of(body, segments)
    heights = float(stance.origins[:, 1].min()) - 0.2, float(stance.origins[:, 1].max()) + 0.4
    figure = Figure(figsize=(PANEL_IN * len(PANELS), (heights[1] - heights[0]) * PANEL_IN / WIDTH_M + 0.4), layout="constrained")
    for axes, panel in zip(figure.subplots(1, len(PANELS)), PANELS, strict=True):
        _draw_body(axes, body, stance, panel)
        if panel.axis is None:
            _draw_triads(axes, stance, segments, body, panel)
        else:
            _draw_arcs(axes, stance, joints, panel)
        axes.set_title(panel.title, fontsize=12)
        axes.set_aspect("equal")
        # The same scale in all panels.
        axes.set_xlim(axes.dataLim.x0 - 0.05, axes.dataLim.x0 - 0.05 + WIDTH_M)
        axes.set_ylim(*heights)
        axes.axis("off")
    with replacing(path) as partial:
        figure.savefig(partial, format="png", dpi=100)
    return tuple(name for joint in joints for name in joint.names)


def stance_of(body: Body, segments: Mapping[str, Segment]) -> Stance:
    """Return the stance: a joint that carries a segment has its anatomical axes, any other is where its parent holds it with angles of zero."""
    skeleton, topology = body.skeleton, body.skeleton.topology
    segment_axes = {segment.joint: axes_of(segment).T for segment in segments.values()}
    presets, offsets = np.asarray(skeleton.presets, float), np.asarray(skeleton.offsets, float)
    rotations, origins = np.zeros_like(presets), np.zeros_like(offsets)
    # A root without anatomical axes: the world's z points up and its x forward.
    world = np.column_stack([X, -Z, Y])
    for j, (name, parent) in enumerate(zip(topology.joint_names, topology.parents, strict=True)):
        above, origin = (rotations[parent], origins[parent]) if parent >= 0 else (world, np.zeros(3))
        rotations[j] = segment_axes.get(name, above @ presets[j])
        origins[j] = origin + above @ offsets[j]
    return Stance(rotations, origins)


def _flat(points: Float[np.ndarray, "*batch 3"], panel: Panel) -> Float[np.ndarray, "*batch 2"]:
    return np.stack([points @ panel.right, points @ panel.up], axis=-1)


def _draw_body(axes: "Axes", body: Body, stance: Stance, panel: Panel) -> None:
    """Draw the outline of every part: between its ends as wide as it is across the line of sight."""
    sight = np.cross(panel.right, panel.up)
    for p, j in enumerate(body.topology.joints):
        R = stance.rotations[j] @ np.asarray(body.presets[p], float)
        base = stance.origins[j] + stance.rotations[j] @ np.asarray(body.offsets[p], float)
        ends = _flat(np.stack([base, base + float(body.lengths[p]) * R[:, 2]]), panel)
        width_axis = np.cross(R[:, 2], sight)
        width_axis /= max(np.linalg.norm(width_axis), 1e-9)
        widths = np.asarray(body.radii[p], float) * float(np.linalg.norm(np.asarray(body.sections[p], float) * (width_axis @ R[:, :2])))
        side = _flat(width_axis, panel)
        corners = [ends[0] + widths[0] * side, ends[1] + widths[1] * side, ends[1] - widths[1] * side, ends[0] - widths[0] * side]
        axes.fill(*np.transpose(corners), facecolor=SKIN, edgecolor="white", linewidth=1.2, zorder=1)


def _draw_triads(axes: "Axes", stance: Stance, segments: Mapping[str, Segment], body: Body, panel: Panel) -> None:
    index = body.skeleton.topology.joint_names.index
    for segment in segments.values():
        j = index(segment.joint)
        anatomical = stance.rotations[j] @ axes_of(segment)
        for axis, colour in enumerate(AXES):
            (x, y), (u, v) = (_flat(stance.origins[j] + reach * anatomical[:, axis], panel).tolist() for reach in (0.0, ARROW_M))
            axes.annotate(
                "", (u, v), (x, y), arrowprops={"arrowstyle": "-|>", "color": colour, "linewidth": 1.6, "shrinkA": 0, "shrinkB": 0}, zorder=3
            )
            # An arrow does not widen the axes.
            axes.plot([x, u], [y, v], linewidth=0)
    for place, (name, colour) in enumerate(zip(NAMES, AXES, strict=True)):
        axes.annotate(name, (0.55, 0.35), xytext=(0, -18 * place), xycoords="axes fraction", textcoords="offset points", color=colour, fontsize=11)


def _draw_arcs(axes: "Axes", stance: Stance, joints: tuple[Joint, ...], panel: Panel) -> None:
    """Draw an arrow about each joint, and the names in a column beside the body, each with a line to its arrow."""
    labels = []
    for joint, place in _turning(joints, panel):
        arc = _flat(stance.origins[joint.distal], panel) + _arc(joint, flat=panel.axis == 1)
        # About x and y, the left side mirrors the right one.
        mirrored = joint.side == "l" and panel.axis != 2
        path = arc if (joint.convention.signs[place] > 0) != mirrored else arc[::-1]
        axes.plot(*arc.T, color=INK, linewidth=1.6, zorder=4)
        (x, y), tip = path[-4], path[-1].tolist()
        axes.annotate("", tuple(tip), (x, y), arrowprops={"arrowstyle": "-|>", "color": INK, "linewidth": 1.6, "mutation_scale": 14}, zorder=4)
        angle = joint.convention.angles[place]
        labels.append((arc[np.argmax(arc[:, 0])], f"{joint.names[joint.free.index(place)]}\n+ {angle.positive}"))
    labels.sort(key=lambda label: -label[0][1])
    column, lowest = axes.dataLim.x1 + 0.1, np.inf
    for (x, y), text in labels:
        lowest = min(y, lowest - LINE_M)
        axes.plot([x, column - 0.06, column - 0.01], [y, lowest, lowest], color=GREY, linewidth=0.7, zorder=2)
        axes.text(column, lowest, text, fontsize=9, va="center")


def _arc(joint: Joint, flat: bool) -> Float[np.ndarray, "point 2"]:
    """Return the points of an arrow relative to its joint, counter-clockwise, which is positive about an axis that points at the reader.

    It is on the side of the segment that moves. About an axis in the picture's plane (`flat`) it is the near half of a circle in perspective.
    """
    above = joint.convention.distal in ("thorax", "head")
    is_laboratory = joint.convention.proximal == LABORATORY
    reach = ARC_M * (1.9 if is_laboratory else 1.0)
    if flat:
        turn = np.radians(np.linspace(-165, -15, 30))
        return reach * np.stack([np.cos(turn), 0.3 * np.sin(turn) + (0.0 if is_laboratory else 1.0 if above else -0.8)], axis=-1)
    middle = 180 if is_laboratory else 90 if above else -90
    turn = np.radians(middle + np.linspace(-35, 35, 30))
    return reach * np.stack([np.cos(turn), np.sin(turn)], axis=-1)


def _turning(joints: tuple[Joint, ...], panel: Panel) -> Iterator[tuple[Joint, int]]:
    """Yield the angles about the panel's axis with their place in the sequence: in the middle of the body and on the right, if it has a right."""
    right = {joint.convention.joint for joint in joints if joint.side == "r"}
    for joint in joints:
        if joint.convention.joint in LEFT_OUT or (joint.side == "l" and joint.convention.joint in right):
            continue
        for place in joint.free:
            if panel.axis is not None and joint.convention.sequence[place] == "XYZ"[panel.axis]:
                yield joint, place
