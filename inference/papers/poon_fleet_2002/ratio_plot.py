"""Plot the errors of two samplers at equal computation: their ratio for each dof, and both over the frames (Poon & Fleet 2002, Fig. 8 and 9)."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from bayes_body.base.files.atomic import replacing
from bayes_body.view.colours import GREY, INK, paper, run_line, run_mark


def draw_ratios(path: Path, figures: Mapping[str, Any]) -> None:
    """Write a .png with the figures of `estimator_variance.py`, and of its `frames` if they exist. Whiskers are 95 % intervals.

    Raises:
        InputError: the file cannot be written.
    """
    from matplotlib.figure import Figure

    along = figures.get("frames")
    figure = Figure(figsize=(14 if along else 7, max(0.35 * len(figures["per_dof"]) + 1.5, 4)), layout="constrained")
    panels = figure.subplots(1, 2 if along else 1, squeeze=False)[0]
    _ratios_by_dof(panels[0], {"evaluations": figures["per_dof"], "seconds": figures["equal_seconds"]["per_dof"]})
    if along:
        _errors_by_frame(panels[1], along)
    with replacing(path) as partial:
        figure.savefig(partial, format="png", dpi=120)


def draw_along(path: Path, along: Mapping[str, Any]) -> None:
    """Write a .png of the errors along the frames alone (Fig. 9).

    Raises:
        InputError: the file cannot be written.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9, 4), layout="constrained")
    _errors_by_frame(figure.subplots(), along)
    with replacing(path) as partial:
        figure.savefig(partial, format="png", dpi=100)


def _ratios_by_dof(axes: Any, ratios: Mapping[str, Mapping[str, Sequence[float]]]) -> None:
    """Draw one row of points for each dof; the mark shows whether evaluations or seconds are equal, the colour the dof's side."""
    dofs = list(ratios["evaluations"])
    places = np.arange(len(dofs))
    for number, (name, of_dofs) in enumerate(ratios.items()):
        for place, dof in enumerate(dofs):
            value, low, high = of_dofs[dof]
            label = None if place else f"at equal {name}"
            style = {"fmt": run_mark(number), "capsize": 3, "color": paper(dof), "label": label}
            axes.errorbar(value, place + 0.15 * number, xerr=[[max(value - low, 0)], [max(high - value, 0)]], **style)
    axes.axvline(1, color=GREY)
    axes.set_yticks(places, [dof.replace("$", r"\$") for dof in dofs])
    axes.set(xscale="log", xlabel="error² of the particle filter / error² of hybrid Monte Carlo")
    axes.invert_yaxis()
    axes.legend()


def _errors_by_frame(axes: Any, along: Mapping[str, Any]) -> None:
    """Draw error² of each filter with its whiskers, and its bias² as a grey line of the same style."""
    for number, (name, figures) in enumerate(along.items()):
        if name == "truth_difference":
            style = {"color": GREY, "linestyle": run_line(len(along) - 1), "label": "difference² of the truth's two runs"}
            axes.plot(np.arange(1, len(figures) + 1), figures, **style)
            continue
        error, frames = np.array(figures["error"]), np.arange(1, len(figures["error"]) + 1) + 0.08 * number
        low, high = np.array(figures["error_interval"]).T
        whiskers = np.stack([np.maximum(error - low, 0), np.maximum(high - error, 0)])
        axes.errorbar(frames, error, yerr=whiskers, fmt=run_mark(number), color=INK, linestyle=run_line(number), capsize=2, label=f"{name}: error²")
        axes.plot(frames, figures["bias"], color=GREY, linestyle=run_line(number), label=f"{name}: bias²")
    axes.set(yscale="log", xlabel="frames filtered", ylabel="error² / variance of the posterior,\nmedian of the dofs")
    axes.xaxis.get_major_locator().set_params(integer=True)
    axes.legend(fontsize="small", loc="upper left", bbox_to_anchor=(1.01, 1.0))
