"""Plots of every dof over time: median, middle half and 90 % of the weighted draws of all runs together."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from numpy.typing import NDArray

from bayes_body.posterior.blocks import coordinate_blocks, pooled, weights_of_runs
from bayes_body.posterior.moments import weighted_quantiles
from bayes_body.view.report.activities import activity_details
from bayes_body.view.report.densities import density_details
from bayes_body.view.report.figures import RUNS, encoded, frame_label, frames_a_point, new_panel, shade_lost, whole_frames
from bayes_body.view.report.inspection import Inspection
from bayes_body.view.report.limbs import by_limb, spoken
from bayes_body.view.report.markup import Markup, Picture, details, figures, section, tag

SEEKER = (
    "The line is the median of the particles of all runs together. There are no bands: the kernel is a mode seeker, and the spread of its particles "
    "is not a measure of uncertainty."
)
ROTATIONS = (
    " The rotation of a part (rx, ry, rz, about its own axes) is measured from its mean in the same frame: the bands show how uncertain it is, and "
    "not how it changes over time."
)
SHARES = (0.05, 0.25, 0.5, 0.75, 0.95)
# A panel spans at least this much, in degrees and metres, so that noise looks like noise.
LEAST_SPAN = {"°": 5.0, "m": 0.02}


class Bands(NamedTuple):
    """Quantiles of the dofs over the frames.

    Attributes:
        frames: the frames.
        dofs: names of the dofs.
        units: unit of each dof, `°` or `m`.
        quantiles: the quantiles at the probabilities SHARES, in those units.
    """

    frames: range
    dofs: tuple[str, ...]
    units: tuple[str, ...]
    quantiles: Float[np.ndarray, "share frame dof"]


def dof_scale(units: tuple[str, ...]) -> Float[np.ndarray, " dof"]:
    """Return the factors that convert radians to degrees and leave metres unchanged."""
    return np.where(np.array(units) == "m", 1.0, 180 / np.pi)


def bands(it: Inspection) -> Bands:
    """Return the bands at no more than MOST_POINTS evenly spaced frames; each run has the same weight."""
    run, found = it.run, []
    frames = range(0, run.frames, frames_a_point(run.frames))
    for piece in coordinate_blocks(run.tree, frames, spaces=run.spaces):
        weights = pooled(weights_of_runs(piece.log_weights)) / piece.poses.shape[0]
        found.append(weighted_quantiles(pooled(piece.poses), weights, SHARES))
    return Bands(frames, it.dofs, it.units, np.concatenate(found, axis=1) * dof_scale(it.units))


def band_section(it: Inspection) -> Markup:
    """Return the section on angles and positions over time, grouped by limb."""
    found, lost = bands(it), it.lost
    step = found.frames.step
    sparse = sparse_frames(step)
    x_label = frame_label(it.fps, sparse)
    legend = (
        "The line is the median of all runs together. The dark band is the middle half of the posterior (25 to 75 %), and the light band is "
        f"90 % of it (5 to 95 %). The draws' weights are taken into account.{_remarks(it, sparse)}"
    )
    if it.diagnosis.mode_seeker:
        legend = f"{SEEKER}{_remarks(it, sparse)}"
    parts: list[str] = [tag("p", legend)]
    for limb, places in by_limb(found.dofs).items():
        panels = figures(_panel(found, place, lost, x_label, not it.diagnosis.mode_seeker) for place in places)
        parts.append(details(limb, panels, shown=True))
    parts += [found for found in (density_details(it), activity_details(it)) if found is not None]
    return section("angles", "Angles and positions", *parts)


def _remarks(it: Inspection, sparse: str) -> str:
    lost = " Lost frames are shaded orange." if it.lost.any() else ""
    turned = ROTATIONS if any(dof.endswith("_rx") for dof in it.dofs) else ""
    return f"{lost}{turned}{f' The plots show {sparse} frame of {it.run.frames:,}.' if sparse else ''}"


def sparse_frames(step: int) -> str:
    """Return for example `every 3rd`; an empty string if no frames are left out."""
    return f"every {_ordinal(step)}" if step > 1 else ""


def _ordinal(number: int) -> str:
    ending = "th" if number % 100 in (11, 12, 13) else {1: "st", 2: "nd", 3: "rd"}.get(number % 10, "th")
    return f"{number}{ending}"


def _panel(found: Bands, place: int, lost: Bool[np.ndarray, " frame"], x_label: str, intervals: bool) -> Picture:
    """Return the plot of a dof over the frames: the median, and with `intervals` the two bands."""
    name, unit = found.dofs[place], found.units[place]
    figure, axes = new_panel(spoken(name), x_label, "angle, degrees" if unit == "°" else "position, m", (3.6, 2.1))
    low, first, middle, third, high = found.quantiles[:, :, place]
    frames = np.asarray(found.frames)
    shade_lost(axes, lost)
    if intervals:
        if len(frames) == 1:
            axes.errorbar(frames, middle, [middle - low, high - middle], color=RUNS[0], marker="o", capsize=4)
        axes.fill_between(frames, low, high, color=RUNS[0], alpha=0.22, linewidth=0)
        axes.fill_between(frames, first, third, color=RUNS[0], alpha=0.4, linewidth=0)
    axes.plot(frames, middle, color=RUNS[0], marker="o" if len(frames) == 1 else "")
    whole_frames(axes, len(lost))
    axes.set_ylim(*limits(low if intervals else middle, high if intervals else middle, LEAST_SPAN[unit]))
    widest = f", widest 90 % band {float(np.max(high - low)):.3g} {unit}" if intervals else ""
    return encoded(figure, f"{spoken(name)} over the frames: median {value_range(middle)} {unit}{widest}.")


def limits(low: NDArray[np.floating], high: NDArray[np.floating], least: float) -> tuple[float, float]:
    """Return the ends of an axis that shows these values with a margin, and spans at least `least`."""
    bottom, top = float(np.min(low)), float(np.max(high))
    margin = max(0.05 * (top - bottom), (least - (top - bottom)) / 2)
    return bottom - margin, top + margin


def value_range(values: NDArray[np.floating]) -> str:
    """Return for example `from 3 to 58.2`."""
    return f"from {float(np.min(values)):.4g} to {float(np.max(values)):.4g}"
