"""The section on the dependence of the angles: a scatter matrix of the dofs that trade off against each other, and a table of their pairs."""

from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float

from bayes_body.view.colours import GREY, INK, paper, run_line, run_mark
from bayes_body.view.report.dependence import LEAST, Dependence, dependence
from bayes_body.view.report.figures import NAMED, encoded
from bayes_body.view.report.inspection import Inspection, equal_weight_sample, spoken
from bayes_body.view.report.markup import Markup, Picture, figures, section, table, tag

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

TITLE = "Dependence of the angles"
ABOUT = (
    "Dofs that trade off against each other: the images determine a combination of them better than each one alone. With a correlation r near −1, "
    "one is larger where the other is smaller; near +1, both are larger together. The band of a single angle does not show this."
)
FRAME = (
    "Shown is frame {frame}{time}, where the strongest pairs have the largest mean r² (without the part that chance explains). r is computed from "
    "all weighted draws within the runs, so that runs that disagree do not look like dofs that depend on each other."
)
NONE = "No two dofs have a correlation of {least:g} or more in any frame with enough effective draws. Each angle can be read for itself."
SEEKER = "The kernel is a mode seeker: the spread of its particles is not a measure of uncertainty, and neither are their correlations."
POINTS = (
    "The dofs of the strongest pairs that fit. Below the diagonal: {count} draws of equal weight of each run; a narrow oblique cloud is a trade-off. "
    "On the diagonal: how many draws have each value. Above it: r, darker where it is stronger."
)
METRES = " Positions are relative to their mean."
# Inches: side of a panel; margins of the whole matrix on the left, right, bottom and top.
SIDE, GAP, EDGES = 1.42, 0.1, (0.95, 0.1, 0.72, 0.36)
BINS = 14


def pair_section(inspection: Inspection) -> Markup:
    """Return the section; a sentence if the draws measure no uncertainty, or if no dofs depend on each other."""
    if inspection.diagnosis.mode_seeker:
        return section("pairs", TITLE, tag("p", SEEKER))
    dependency = dependence(inspection)
    if not dependency.pairs:
        return section("pairs", TITLE, tag("p", NONE.format(least=LEAST)))
    time = f" (at {dependency.frame / inspection.fps:.2f} s)" if inspection.fps else ""
    parts = [tag("p", ABOUT), tag("p", FRAME.format(frame=inspection.number(dependency.frame), time=time)), _pair_table(inspection, dependency)]
    return section("pairs", TITLE, *parts, figures([_matrix(inspection, dependency)], "matrix"))


def _pair_table(inspection: Inspection, dependency: Dependence) -> Markup:
    """Return the strongest pairs with their correlation in the shown frame and over all frames."""
    rows = []
    for first, second in dependency.pairs:
        values = dependency.correlations[:, first, second]
        low, middle, high = np.nanpercentile(values, (5, 50, 95))
        name = f"{spoken(inspection.dofs[first])} and {spoken(inspection.dofs[second])}"
        over = [f"{_signed(middle)} ({_signed(low)} to {_signed(high)})"] if len(values) > 1 else []
        rows.append([name, _signed(float(values[dependency.place])), *over])
    head = [
        "pair",
        f"r in frame {inspection.number(dependency.frame)}",
        *(["r over the frames: median (5 to 95 %)"] if len(dependency.correlations) > 1 else []),
    ]
    return table(head, rows)


def _signed(r: float) -> str:
    """Return the correlation with its sign; a true minus, as wide as a plus."""
    return f"{r:+.2f}".replace("-", "−")


def _matrix(inspection: Inspection, dependency: Dependence) -> Picture:
    """Return the scatter matrix."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    count, (left, right, bottom, top) = len(dependency.dofs), EDGES
    width, height = left + count * SIDE + right, bottom + count * SIDE + top
    figure = Figure(figsize=(width, height))
    FigureCanvasAgg(figure)
    figure.subplots_adjust(left / width, bottom / height, 1 - right / width, 1 - top / height, GAP, GAP)
    values, labels = _values(inspection, dependency)
    grid = figure.subplots(count, count, squeeze=False)
    for row in range(count):
        for column in range(count):
            axes, r = grid[row, column], dependency.correlations[dependency.place, dependency.dofs[row], dependency.dofs[column]]
            if row == column:
                _distribution(axes, values[..., row], paper(inspection.dofs[dependency.dofs[row]]))
            elif row > column:
                _cloud(axes, values[..., column], values[..., row])
            else:
                _coefficient(axes, float(r))
            _ticks(axes, labels, row, column, count)
    _legend(figure, inspection.runs)
    pairs = "; ".join(
        f"{spoken(inspection.dofs[j])} and {spoken(inspection.dofs[k])} {_signed(dependency.correlations[dependency.place, j, k])}"
        for j, k in dependency.pairs
    )
    caption = POINTS.format(count=values.shape[1]) + (METRES if any(label.endswith("mm") for label in labels) else "")
    return encoded(figure, f"Scatter matrix of {count} dofs at frame {inspection.number(dependency.frame)}. Correlations: {pairs}.", caption)


def _values(inspection: Inspection, dependency: Dependence) -> tuple[Float[np.ndarray, "run draw dof"], list[str]]:
    """Return draws of equal weight, degrees and millimetres from the mean, and the labels of their axes."""
    poses = equal_weight_sample(inspection, dependency.frame).poses[..., list(dependency.dofs)]
    long = np.array([inspection.units[dof] == "m" for dof in dependency.dofs])
    values = np.where(long, 1000 * (poses - poses.mean(axis=(0, 1))), poses)
    return values, [f"{spoken(inspection.dofs[dof])},\n{'mm' if metres else 'degrees'}" for dof, metres in zip(dependency.dofs, long, strict=True)]


def _distribution(axes: "Axes", values: Float[np.ndarray, "run draw"], colour: str) -> None:
    edges = np.linspace(values.min(), values.max(), BINS + 1)
    for run, draws in enumerate(values):
        axes.hist(draws, edges, histtype="step", color=colour, linestyle=run_line(run), linewidth=1.3)
    axes.margins(x=0.06)


def _cloud(axes: "Axes", x: Float[np.ndarray, "run draw"], y: Float[np.ndarray, "run draw"]) -> None:
    for run in range(len(x)):
        mark = run_mark(run)
        # A mark without an inside consists of its line.
        axes.scatter(x[run], y[run], s=7 if mark == "o" else 11, marker=mark, color=INK, alpha=0.5, linewidths=0.8 if mark in "x+1" else 0)
    axes.margins(0.06)


def _coefficient(axes: "Axes", r: float) -> None:
    """Write the correlation; the stronger, the darker its field."""
    # Not the background of the axes, which is transparent in all plots of the page.
    axes.axhspan(0, 1, color=GREY, alpha=0.5 * abs(r), linewidth=0)
    axes.set_ylim(0, 1)
    axes.text(0.5, 0.5, _signed(r), transform=axes.transAxes, ha="center", va="center", fontsize=12, color=INK)
    axes.grid(visible=False)


def _ticks(axes: "Axes", labels: list[str], row: int, column: int, count: int) -> None:
    """Number the axes on the left and at the bottom only; a distribution has no height to read."""
    from matplotlib.ticker import MaxNLocator

    axes.xaxis.set_major_locator(MaxNLocator(3))
    axes.yaxis.set_major_locator(MaxNLocator(3))
    if row < column:
        axes.set(xticks=[], yticks=[])
    if row == column:
        axes.set_yticks([])
        axes.grid(visible=False)
    if row < count - 1:
        axes.tick_params(labelbottom=False)
    else:
        axes.set_xlabel(labels[column])
    if column == 0:
        axes.set_ylabel(labels[row])
    if column > 0:
        axes.tick_params(labelleft=False)


def _legend(figure: "Figure", runs: int) -> None:
    if 1 < runs <= NAMED:
        from matplotlib.lines import Line2D

        style = {"color": INK, "markersize": 4, "linewidth": 1.3}
        marks = [Line2D([], [], marker=run_mark(run), linestyle=run_line(run), label=f"run {run + 1}", **style) for run in range(runs)]
        figure.legend(handles=marks, loc="upper right", ncols=runs, handlelength=2.6, handletextpad=0.5, columnspacing=1.0, labelcolor=INK)
