"""Panels over the frames of a run: empty, or with a line for each run."""

from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float

from bayes_body.view.report.figures import PANEL, draw_runs, new_panel, shade_lost, time_axis
from bayes_body.view.report.inspection import Inspection

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


def frame_panel(inspection: Inspection, title: str, x: str, y: str, size: tuple[float, float] = PANEL) -> "tuple[Figure, Axes]":
    """Return an empty panel over the frames of a run, with the lost frames shaded."""
    figure, axes = new_panel(title, x, y, size)
    shade_lost(axes, inspection.lost)
    time_axis(axes, inspection.run.frames, inspection.fps)
    return figure, axes


def run_panel(inspection: Inspection, title: str, y: str, values: Float[np.ndarray, "run frame"]) -> "tuple[Figure, Axes]":
    """Return a panel with a line for each run over the frames."""
    figure, axes = frame_panel(inspection, title, inspection.x_label, y)
    draw_runs(axes, np.arange(values.shape[1]), values)
    # Names of lines are placed by the limits of the axes, which would otherwise be found only when the panel is drawn.
    axes.autoscale_view()
    return figure, axes
