"""The log posterior of a shoulder's three angles over the frames (Sidenbladh, Black & Fleet 2000, Fig. 4).

Bands hide that a posterior has several modes or fills a whole range, as that of a straight arm's twist does.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from bayes_body.results.posterior.blocks import coordinate_blocks, pooled, weights_of_runs
from bayes_body.view.colours import SEQUENTIAL
from bayes_body.view.report.figures import encoded, frames_a_point, new_panel, set_margins, time_axis, time_label
from bayes_body.view.report.inspection import Inspection
from bayes_body.view.report.limbs import spoken
from bayes_body.view.report.markup import Markup, Picture, details, figures, tag

SHOULDER, BINS = "shoulder", 60
# Fainter than the frame's mode by more than this, in natural logarithms, is white.
FAINTEST = 6.0
LEGEND = "How probable each angle is in each frame: the natural logarithm of the posterior, relative to the most probable angle. All runs together."


def density_details(it: Inspection) -> Markup | None:
    """Return the panels of every shoulder's angles; None if the body has none, or if the spread of the particles means nothing."""
    places = [place for place, name in enumerate(it.dofs) if SHOULDER in name and it.units[place] == "°"]
    if not places or it.diagnosis.mode_seeker:
        return None
    frames = range(0, it.run.frames, frames_a_point(it.run.frames))
    blocks = list(coordinate_blocks(it.run.tree, frames, spaces=it.run.spaces))
    weights = np.concatenate([pooled(weights_of_runs(piece.log_weights)) / piece.poses.shape[0] for piece in blocks])
    angles = np.degrees(np.concatenate([pooled(piece.poses)[..., places] for piece in blocks]))
    label = time_label(it.fps)
    panels = figures(_panel(it, it.dofs[place], frames, log_density(angles[..., k], weights), label) for k, place in enumerate(places))
    return details("Log posterior of the shoulders' angles", tag("p", LEGEND), panels)


class LogDensity(NamedTuple):
    """The log-density relative to each frame's largest, in bins from `low` to `high`, degrees."""

    values: Float[np.ndarray, "bin frame"]
    low: float
    high: float


def log_density(angles: Float[np.ndarray, "frame draw"], weights: Float[np.ndarray, "frame draw"]) -> LogDensity:
    """Return the histogram of weighted angles in each frame, as logarithms; bins without weight are -inf."""
    low, high = float(angles.min()), float(angles.max())
    margin = max(1.0 - (high - low) / 2, 0.0)
    low, high = low - margin, high + margin
    bins = np.minimum(((angles - low) / (high - low) * BINS).astype(int), BINS - 1)
    mass = np.zeros((BINS, len(angles)))
    np.add.at(mass, (bins, np.arange(len(angles))[:, None]), weights)
    with np.errstate(divide="ignore"):
        return LogDensity(np.log(mass) - np.log(mass.max(axis=0)), low, high)


def _panel(it: Inspection, name: str, frames: range, density: LogDensity, label: str) -> Picture:
    values, low, high = density
    figure, axes = new_panel(spoken(name), label, "angle, degrees", (3.6, 2.3))
    set_margins(figure, 0.66, 0.42)
    axes.grid(visible=False)
    last = frames[-1] + frames.step / 2
    shown = axes.imshow(
        np.maximum(values, -FAINTEST),
        extent=(-frames.step / 2, last, low, high),
        origin="lower",
        aspect="auto",
        interpolation="nearest",
        cmap=SEQUENTIAL,
        vmin=-FAINTEST,
        vmax=0,
    )
    time_axis(axes, it.run.frames, it.fps)
    figure.colorbar(shown, ax=axes, pad=0.03, ticks=[-FAINTEST, -FAINTEST / 2, 0])
    return encoded(figure, f"Log posterior of {spoken(name)} over the frames, angles from {low:.0f} to {high:.0f} degrees.")
