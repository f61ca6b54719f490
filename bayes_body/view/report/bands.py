"""Plots of every dof over time: mean and 90 % interval of the weighted draws of all runs together."""

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from bayes_body.view.colours import paper
from bayes_body.view.report.activities import activity_details
from bayes_body.view.report.curves import LEGEND, draw_filter, drawn_filter
from bayes_body.view.report.dependence import density_details
from bayes_body.view.report.figures import encoded, time_label
from bayes_body.view.report.inspection import Inspection, by_limb, spoken
from bayes_body.view.report.markup import Markup, Picture, details, figures, section, tag
from bayes_body.view.report.panels import frame_panel

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Curve = NDArray[np.floating]
SEEKER = (
    "The line is the mean of the particles of all runs together. There are no bands: the kernel is a mode seeker, and the spread of its particles "
    "is not a measure of uncertainty."
)
ROTATIONS = (
    " The rotation of a part (rx, ry, rz, about its own axes) is measured from its mean in the same frame: the bands show how uncertain it is, and "
    "not how it changes over time."
)
BANDS = "The line is the mean of all runs together, and the band the 90 % interval. The draws' weights are taken into account."
SIDES = " The left side is blue, the right side orange, the middle of the body green."
# A panel spans at least this much, in degrees and metres, so that noise looks like noise.
LEAST_SPAN = {"°": 5.0, "m": 0.02}


def band_section(inspection: Inspection) -> Markup:
    """Return the section on angles and positions over time, grouped by limb."""
    legend = SEEKER if inspection.diagnosis.mode_seeker else BANDS
    parts: list[str] = [tag("p", f"{legend}{SIDES}{_remarks(inspection)}")]
    for limb, places in by_limb(inspection.dofs).items():
        parts.append(details(limb, figures(_panel(inspection, place) for place in places), shown=True))
    parts += [panel for panel in (density_details(inspection), activity_details(inspection)) if panel is not None]
    return section("angles", "Angles and positions", *parts)


def _remarks(inspection: Inspection) -> str:
    lost = " Lost frames are shaded purple." if inspection.lost.any() else ""
    turned = ROTATIONS if any(dof.endswith("_rx") for dof in inspection.dofs) else ""
    sparse = sparse_frames(inspection.frames.step)
    return f"{LEGEND if inspection.filtered else ''}{lost}{turned}{f' The plots show {sparse} frame of {inspection.run.frames:,}.' if sparse else ''}"


def sparse_frames(step: int) -> str:
    """Return for example `every 3rd`; an empty string if no frames are left out."""
    return f"every {_ordinal(step)}" if step > 1 else ""


def _ordinal(number: int) -> str:
    ending = "th" if number % 100 in (11, 12, 13) else {1: "st", 2: "nd", 3: "rd"}.get(number % 10, "th")
    return f"{number}{ending}"


def _panel(inspection: Inspection, place: int) -> Picture:
    """Return the plot of a dof over time: the mean and, unless the kernel is a mode seeker, the band."""
    name, unit, bands = spoken(inspection.dofs[place]), inspection.units[place], not inspection.diagnosis.mode_seeker
    sparse = sparse_frames(inspection.frames.step)
    label = time_label(inspection.fps, f"{sparse} frame" if sparse else "")
    figure, axes = frame_panel(inspection, name, label, "angle, degrees" if unit == "°" else "position, m", (3.6, 2.1))
    mean, low, high = (values[:, place] for values in (inspection.curves.mean, inspection.curves.q05, inspection.curves.q95))
    frames = np.asarray(inspection.frames)
    if inspection.filtered:
        draw_filter(axes, frames, inspection.filtered.dofs, place, bands)
    draw_band(axes, frames, mean, (low, high) if bands else None, paper(inspection.dofs[place]))
    shown = [mean, low, high] if bands else [mean]
    shown += drawn_filter(inspection.filtered.dofs, place, bands) if inspection.filtered else []
    axes.set_ylim(*limits(np.concatenate(shown), LEAST_SPAN[unit]))
    widest = f", widest 90 % band {float(np.max(high - low)):.3g} {unit}" if bands else ""
    return encoded(figure, f"{name} over the frames: mean {value_range(mean)} {unit}{widest}.")


def draw_band(axes: "Axes", places: NDArray[Any], mean: Curve, band: tuple[Curve, Curve] | None, ink: str, label: str | None = None) -> None:
    """Draw a mean as a line, or for a single frame as a point; with the ends of its interval, if there is one. The label is the line's."""
    if len(places) == 1:
        # The mean of a skewed distribution can be outside its interval.
        ends = np.maximum([mean - band[0], band[1] - mean], 0) if band else None
        axes.errorbar(places, mean, ends, color=ink, marker="o", capsize=4, label=label)
        return
    if band:
        axes.fill_between(places, band[0], band[1], color=ink, alpha=0.25, linewidth=0)
    axes.plot(places, mean, color=ink, label=label)


def limits(values: Curve, least: float) -> tuple[float, float]:
    """Return the ends of an axis that shows these values with a margin, and spans at least `least`."""
    bottom, top = float(np.min(values)), float(np.max(values))
    margin = max(0.05 * (top - bottom), (least - (top - bottom)) / 2)
    return bottom - margin, top + margin


def value_range(values: NDArray[np.floating]) -> str:
    """Return for example `from 3 to 58.2`."""
    return f"from {float(np.min(values)):.4g} to {float(np.max(values)):.4g}"
