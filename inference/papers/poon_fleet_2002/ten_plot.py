"""Plot the ratios of all mixtures that `ten_mixtures.py` has measured (Poon & Fleet 2002, Fig. 8)."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from bayes_body.base.files.atomic import replacing
from bayes_body.view.colours import GREY, INK


def draw_mixtures(path: Path, rows: Sequence[Mapping[str, Any]]) -> None:
    """Write a .png with the median and the worst dof of each mixture, with 95 % intervals. Hollow marks: the true mean is not known well enough.

    Raises:
        InputError: the file cannot be written.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(8, 0.45 * len(rows) + 1.6), layout="constrained")
    axes = figure.subplots()
    for key, mark, shift, label in (("ratio", "o", 0.0, "median of the dofs"), ("worst", "v", 0.22, "worst dof")):
        for place, row in enumerate(rows):
            value = row["ratio_median"] if key == "ratio" else row["worst_ratio"]
            low, high = row[f"{key}_interval"]
            style = {"fmt": mark, "color": INK, "capsize": 3, "markerfacecolor": INK if row["truth_known"] else "none"}
            # A median of resampled medians may be outside the interval by rounding.
            whiskers = [[max(value - low, 0)], [max(high - value, 0)]]
            axes.errorbar(value, place + shift, xerr=whiskers, label=None if place else label, **style)
    axes.axvline(1, color=GREY)
    axes.set_yticks(np.arange(len(rows)), [f"{row['walk']}{'*' if row['held_out'] else ''}, frame {row['frame']}" for row in rows])
    axes.set(xscale="log", xlabel="error² of the particle filter / error² of hybrid Monte Carlo, equal evaluations")
    axes.invert_yaxis()
    axes.legend()
    with replacing(path) as partial:
        figure.savefig(partial, format="png", dpi=120)
