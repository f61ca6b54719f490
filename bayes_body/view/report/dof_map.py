"""R-hat of every dof and frame as a map: one row for each dof, frames from left to right."""

import numpy as np
from jaxtyping import Float

from bayes_body.view.colours import BAD, INK
from bayes_body.view.report.figures import bins, encoded, new_panel, set_margins, time_axis
from bayes_body.view.report.inspection import Inspection
from bayes_body.view.report.limbs import spoken
from bayes_body.view.report.markup import Picture


def dof_map(it: Inspection, rhat: Float[np.ndarray, "frame dof"], title: str, limit: float, alt: str, caption: str) -> Picture:
    """Return the map; a line on the colour scale marks the limit."""
    from matplotlib.ticker import MaxNLocator

    frames, count = rhat.shape
    figure, axes = new_panel(title, it.x_label, "", (4.2, 0.9 + 0.17 * count))
    set_margins(figure, 1.2, 0.42)
    axes.grid(visible=False)
    shown = axes.imshow(
        _binned(rhat).T,
        extent=(-0.5, frames - 0.5, count - 0.5, -0.5),
        aspect="auto",
        interpolation="nearest",
        cmap=BAD,
        vmin=1,
        vmax=max(2 * limit - 1, 1.2),
    )
    axes.set_yticks(range(count), [spoken(name) for name in it.diagnosis.dofs], fontsize=8.5)
    time_axis(axes, frames, it.fps)
    axes.set_xlim(-0.5, frames - 0.5)
    bar = figure.colorbar(shown, ax=axes, extend="max", pad=0.03, ticks=MaxNLocator(5, steps=[1, 2, 5, 10]), format="%.2f")
    bar.ax.axhline(limit, color=INK, linewidth=1.2)
    return encoded(figure, alt, caption)


def _binned(values: Float[np.ndarray, "frame dof"]) -> Float[np.ndarray, "bin dof"]:
    """Return the largest value in each bin of frames, so that no single large value is lost between pixels."""
    known = np.nan_to_num(values, nan=-np.inf)
    largest = np.stack([known[piece].max(axis=0) for piece in bins(len(values))])
    return np.where(np.isneginf(largest), np.nan, largest)
