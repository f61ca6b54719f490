"""ArviZ's plots of a dof at a frame, and of all angles of a frame.

ArviZ does not use weights. It is given draws of equal weight, as many as the smallest effective sample size of the runs at that frame, so that the
plots do not look more precise than the weighted draws are.
"""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float

from bayes_body.view.colours import INK, WARNING, paper, run_line
from bayes_body.view.report.figures import MARGINS, PANEL, encoded, run_label, set_margins
from bayes_body.view.report.inspection import Inspection, Sample, spoken
from bayes_body.view.report.markup import Picture
from bayes_body.view.report.ranks import rank_region

if TYPE_CHECKING:
    import xarray as xr
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# With more runs than this, a forest plot pools them.
FOREST_RUNS = 4
# Number of effective draws that quantiles need (Vehtari et al. 2021).
ENOUGH = 400


@contextmanager
def arviz_plots() -> Iterator[None]:
    """Within it, pyplot, which ArviZ uses, draws without a window. The caller's backend is restored at the end."""
    import matplotlib as mpl

    backend = mpl.get_backend()
    mpl.use("Agg")
    try:
        yield
    finally:
        mpl.use(backend)


def _taken(draw: Callable[..., Any], size: tuple[float, float], **arguments: Any) -> "Figure":
    """Return the figure that an ArviZ plot makes, and close it in pyplot."""
    import matplotlib.pyplot as plt

    collection = draw(backend="matplotlib", figure_kwargs={"figsize": size}, **arguments)
    figure = collection.viz["figure"].item()
    plt.close(figure)
    return figure


def _tree(values: Float[np.ndarray, "run draw"]) -> "xr.DataTree":
    import xarray as xr

    places = {dim: np.arange(size) for dim, size in zip(("chain", "draw"), values.shape, strict=True)}
    return xr.DataTree.from_dict({"posterior": xr.Dataset({"value": (("chain", "draw"), values)}, places)})


def _named(inspection: Inspection, sample: Sample, dof: int) -> tuple[str, str]:
    """Return the title of a panel and the dof's unit."""
    return f"{spoken(inspection.dofs[dof])}, frame {inspection.number(sample.frame)}", inspection.units[dof]


def _label(figure: "Figure", title: str, x: str, y: str) -> "Axes":
    axes = figure.axes[0]
    for side in ("left", "bottom"):
        axes.spines[side].set_visible(True)
    axes.tick_params(left=True, labelleft=True)
    axes.set_title("", loc="center")
    axes.set_title(title, loc="left")
    axes.set(xlabel=x, ylabel=y)
    set_margins(figure)
    return axes


def _draw_as_runs(axes: "Axes", inspection: Inspection, dof: int) -> None:
    """Give the first lines, one of each run in order, the colour of the dof's side, the run's line style and its name."""
    for run, line in enumerate(axes.get_lines()[: inspection.runs]):
        line.set(color=paper(inspection.dofs[dof]), linestyle=run_line(run), label=run_label(run, inspection.runs))


def rank_plot(inspection: Inspection, sample: Sample, dof: int) -> Picture:
    """Return the rank plot: the ranks of each run's draws among all draws, as the difference from uniform (Säilynoja, Bürkner & Vehtari 2022)."""
    import arviz as az

    title, _ = _named(inspection, sample, dof)
    values, rhat = sample.poses[..., dof], inspection.diagnosis.rhat[sample.frame, dof]
    figure = _taken(az.plot_rank, PANEL, dt=_tree(values), visuals={"remove_axis": False})
    rank = f"rank among all draws of frame {inspection.number(sample.frame)}"
    axes = _label(figure, f"{spoken(inspection.dofs[dof])}: R-hat {rhat:.2f}", rank, "difference from uniform")
    _draw_as_runs(axes, inspection, dof)
    # Remove the p-value and the points of ArviZ's test: it assumes independent draws, and no option turns it off.
    for artist in (*axes.texts, *axes.collections):
        artist.remove()
    places = np.linspace(0, 1, 101)
    height = rank_region(*values.shape) * np.sqrt(places * (1 - places))
    axes.fill_between(places, -height, height, color=INK, alpha=0.12, linewidth=0)
    axes.relim()
    axes.autoscale(axis="y")
    # Differences have three decimals.
    set_margins(figure, MARGINS[0] + 0.14)
    return encoded(figure, f"Rank plot of {title}: R-hat {rhat:.2f}.")


def distribution_plot(inspection: Inspection, sample: Sample, dof: int) -> Picture:
    """Return the distribution plot: for each run, the fraction of its draws below each value."""
    import arviz as az

    title, unit = _named(inspection, sample, dof)
    values = sample.poses[..., dof]
    hidden = dict.fromkeys(("point_estimate", "point_estimate_text", "credible_interval", "remove_axis"), False)
    by_run = {"sample_dims": ["draw"], "cols": [], "aes": {"color": ["chain"]}}
    figure = _taken(az.plot_dist, PANEL, dt=_tree(values), kind="ecdf", visuals=hidden, **by_run)
    axes = _label(figure, title, "angle, degrees" if unit == "°" else "position, m", "fraction of draws below")
    _draw_as_runs(axes, inspection, dof)
    return encoded(figure, f"Distribution of {title}, by run: means {', '.join(f'{mean:.3g} {unit}' for mean in values.mean(axis=1))}.")


def growth_plot(inspection: Inspection, sample: Sample, dof: int) -> Picture:
    """Return the plot of ArviZ's effective sample size as draws are added."""
    import arviz as az

    title, _ = _named(inspection, sample, dof)
    values = sample.poses[..., dof]
    figure = _taken(az.plot_ess_evolution, PANEL, dt=_tree(values), n_points=10, visuals={"min_ess": values.size >= ENOUGH})
    axes = _label(figure, title, "draws of all runs", "effective draws")
    axes.set_ylim(bottom=0)
    bulk, tails, *limit_lines = axes.get_lines()
    for line, name, style in ((bulk, "bulk", run_line(0)), (tails, "tails", run_line(1))):
        line.set(color=paper(inspection.dofs[dof]), linestyle=style, label=name)
    for points in axes.collections:
        points.set_color(paper(inspection.dofs[dof]))
    for line in limit_lines:
        line.set(color=WARNING, linestyle="-")
    return encoded(figure, f"Effective sample size of {title} as draws are added.")


def forest_plot(inspection: Inspection, sample: Sample) -> Picture:
    """Return the plot of the median and intervals of every angle, by run, relative to the median of all runs."""
    import arviz as az
    import xarray as xr

    angular = np.array(inspection.units) == "°"
    angles, is_pooled = sample.poses[..., angular], inspection.runs > FOREST_RUNS
    middle = np.median(angles, axis=(0, 1))
    names = [spoken(name) for name, angle in zip(inspection.dofs, angular, strict=True) if angle]
    labels = [f"{name} {value:z.0f}°" for name, value in zip(names, middle, strict=True)]
    coordinates = {"dof": labels, "chain": np.arange(len(angles)), "draw": np.arange(angles.shape[1])}
    tree = xr.DataTree.from_dict({"posterior": xr.Dataset({"angle": (("chain", "draw", "dof"), angles - middle)}, coordinates)})
    form = {
        "labels": ["dof"],
        "point_estimate": "median",
        "ci_probs": (0.9, 0.9),
        "combined": is_pooled,
        "aes": {} if is_pooled else {"color": ["chain"]},
    }
    figure = _taken(az.plot_forest, (3.8, 0.8 + 0.3 * len(names)), dt=tree, visuals={"point_estimate": {"width": 2}}, **form)
    _set_forest(figure, f"Frame {inspection.number(sample.frame)}")
    _draw_sides(figure.axes[1], [paper(name) for name, angle in zip(inspection.dofs, angular, strict=True) if angle])
    return encoded(figure, f"Medians and intervals of {len(names)} joint angles at frame {inspection.number(sample.frame)}, by run.")


def _draw_sides(axes: "Axes", inks: list[str]) -> None:
    """Give each angle's intervals and medians the colour of its side, and each run its line style. ArviZ draws run after run, all angles of each."""
    for place, line in enumerate(axes.get_lines()):
        # Lines of the outer and of the inner interval, both of which are the same one here, follow each other.
        line.set(color=inks[place % len(inks)], linestyle=run_line(place % (len(axes.collections)) // len(inks)))
    for place, point in enumerate(axes.collections):
        point.set_color(inks[place % len(inks)])


def _set_forest(figure: "Figure", title: str) -> None:
    """Put the names on the left and the intervals on the right, with enough room for both."""
    names, intervals = figure.axes
    (width, height), (_, right, bottom, top) = figure.get_size_inches(), MARGINS
    edge, low, high = 1.75 / width, bottom / height, 1 - top / height
    names.set_position((0, low, edge, high - low))
    intervals.set_position((edge, low, 1 - edge - right / width, high - low))
    names.set_axis_off()
    intervals.set_title(title, loc="left")
    intervals.set_xlabel("degrees from the median")
