"""The clinical angles over time: mean and 90 % interval of all runs together, the right and the left side in one panel."""

from collections.abc import Mapping

import numpy as np

from bayes_body.results.clinical.conventions import CLINICAL, Angle, Convention
from bayes_body.results.metrics.unknown_sentences import UNDETERMINED
from bayes_body.results.posterior.moments import Moments
from bayes_body.view.colours import SIDES as COLOURS
from bayes_body.view.report.bands import LEAST_SPAN, draw_band, limits, sparse_frames, value_range
from bayes_body.view.report.curves import LEGEND, draw_filter, drawn_filter
from bayes_body.view.report.figures import encoded, new_panel, shade_lost
from bayes_body.view.report.inspection import Inspection
from bayes_body.view.report.markup import Markup, Picture, details, figures, section, tag

SIDES = {"r": "right", "l": "left", "": ""}
LINES = (
    "Joint angles as clinicians read them: left blue, right orange, trunk and head green. The same sign is the same movement on both sides. The line "
    "is the "
)
BANDS = f"{LINES}posterior mean of all runs together, and the band the 90 % interval: angles of the draws, not angles of a mean."
SEEKER = (
    f"{LINES}mean of the particles of all runs together. There are no bands: the kernel is a mode seeker, and the spread of its particles is not a "
    "measure of uncertainty."
)
HANGING = "Plane and rotation of the shoulder are undetermined while the arm hangs: read the angles of the arm on the thorax there."
# What is written at an angle that the images do not determine, and what it means.
UNDETERMINED_MARK = "not determined"
UNDETERMINED_NOTE = (
    f"Not determined by the images: the posterior is as wide as the motion prior (more than {UNDETERMINED:.0%} of its standard deviation in the long "
    "run). Such a curve shows what the prior expects, and no measurement: "
)
# Joints that are folded at first: their angles repeat those of another joint, in another sequence.
FOLDED = ("shoulder",)


def clinical_section(inspection: Inspection) -> Markup:
    """Return the section, one group of panels for each joint."""
    parts: list[str] = [tag("p", f"{SEEKER if inspection.diagnosis.mode_seeker else BANDS}{LEGEND if inspection.filtered else ''}")]
    sparse = sparse_frames(inspection.frames.step)
    if sparse:
        parts.append(tag("p", f"The plots show {sparse} frame of {inspection.run.frames:,}.", class_="note"))
    if inspection.undetermined:
        listed = (name for name in inspection.clinical.names if name in inspection.undetermined)
        parts.append(tag("p", f"{UNDETERMINED_NOTE}{', '.join(listed)}.", class_="note"))
    for convention in CLINICAL:
        panels = [panel for place, angle in enumerate(convention.angles) if (panel := _panel(inspection, convention, angle, place)) is not None]
        if panels:
            note = [tag("p", HANGING, class_="note")] if convention.joint in FOLDED else []
            parts.append(details(convention.joint.capitalize(), *note, figures(panels), shown=convention.joint not in FOLDED))
    return section("clinical", "Clinical angles", *parts)


def _panel(inspection: Inspection, convention: Convention, angle: Angle, place: int) -> Picture | None:
    """Return the plot of an angle on its sides; None if the body does not have it."""
    names, moments = inspection.clinical
    sides = {side: names.index(convention.names(side)[place]) for side in convention.sides if convention.names(side)[place] in names}
    if not sides:
        return None
    curves = {side: Moments(*(values[:, column] for values in moments)) for side, column in sides.items()}
    title = angle.name.replace("_", " ").capitalize()
    figure, axes = new_panel(title, "time, s", "degrees", (3.6, 2.1))
    seconds, bands = np.asarray(inspection.frames) / inspection.run.fps, not inspection.diagnosis.mode_seeker
    shade_lost(axes, inspection.lost, 1 / inspection.run.fps)
    shown: list[np.ndarray] = []
    for side, curve in curves.items():
        if inspection.filtered and names == inspection.filtered.clinical.names:
            draw_filter(axes, seconds, inspection.filtered.clinical.moments, sides[side], bands)
            shown += drawn_filter(inspection.filtered.clinical.moments, sides[side], bands)
        draw_band(axes, seconds, curve.mean, (curve.q05, curve.q95) if bands else None, COLOURS[side], SIDES[side] or None)
        shown += [curve.mean, curve.q05, curve.q95] if bands else [curve.mean]
    if len(seconds) > 1:
        axes.set_xlim(seconds[0], seconds[-1])
    axes.set_ylim(*limits(np.concatenate(shown), LEAST_SPAN["°"]))
    marks = {side: f", {UNDETERMINED_MARK}" if names[column] in inspection.undetermined else "" for side, column in sides.items()}
    descriptions = [
        f"{SIDES[side]} mean {value_range(curve.mean)} °{_widest(curve) if bands else ''}{marks[side]}".strip() for side, curve in curves.items()
    ]
    return encoded(figure, f"{title} over time: {'; '.join(descriptions)}.", _caption(angle, marks))


def _caption(angle: Angle, marks: Mapping[str, str]) -> str:
    open_sides = " and ".join(SIDES[side] for side, mark in marks.items() if mark)
    only = f" ({open_sides})" if open_sides and not all(marks.values()) else ""
    return f"+ {angle.positive}; − {angle.negative}{f'; {UNDETERMINED_MARK}{only}' if any(marks.values()) else ''}"


def _widest(curve: Moments) -> str:
    return f", widest 90 % band {float(np.max(curve.q95 - curve.q05)):.3g} °"
