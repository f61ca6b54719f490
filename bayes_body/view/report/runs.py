"""Whether the runs agree: R-hat of every dof and frame, and a closer look at a few."""

from collections.abc import Iterator, Sequence

import numpy as np
from jaxtyping import Float

from bayes_body.view.report.choice import Sample, chosen_dofs, chosen_frames, equal_weight_sample, worst_frame
from bayes_body.view.report.close_ups import arviz_plots, distribution_plot, forest_plot, growth_plot, rank_plot
from bayes_body.view.report.figures import INK, bins, encoded, new_panel, set_margins, whole_frames
from bayes_body.view.report.head import sentence
from bayes_body.view.report.inspection import Inspection
from bayes_body.view.report.limbs import spoken
from bayes_body.view.report.markup import Markup, Picture, figures, section, tag

RANKS = (
    "The draws of all runs are ranked together, and each run's share of the ranks is held against an even share. A line that leaves the grey region "
    "(where 95 % of agreeing sets of runs stay) is a run that lies elsewhere than the others: high for smaller values, low for larger ones."
)
GROWTH = (
    "ArviZ's effective sample size of the bulk and the tails as draws are added. It sees how far runs differ, but not that draws of one run share "
    "ancestors: read it with the effective particles and the ancestors above. It should grow in a straight line; a dashed line is at 400 draws."
)
FOREST = (
    "Median, middle half (thick) and 94 % (thin) of each run's draws, as their distance from the median of all runs, which stands beside the name: "
    "short lines are joints that the recording pins down, lines that lie apart are runs that disagree."
)


def run_section(it: Inspection) -> Markup:
    """R-hat where there are several runs, ArviZ's plots of the first, the worst and the last frame."""
    frames, dofs = chosen_frames(it), chosen_dofs(it)
    samples = [equal_weight_sample(it, frame) for frame in frames]
    worst = samples[frames.index(worst_frame(it))]
    with arviz_plots():
        parts = [*_agreement(it, samples, dofs), *_close_ups(it, worst, dofs)]
        parts += [tag("h3", "All angles"), tag("p", FOREST), figures(forest_plot(it, sample) for sample in samples)] if "°" in it.units else []
    draws = ", ".join(f"{sample.poses.shape[1]} at frame {sample.frame}" for sample in samples)
    note = tag("p", f"Made by ArviZ from draws of equal weight, as many a run as the weights are worth: {draws}.", class_="note")
    return section("runs", "Do the runs agree?", *parts, note)


def _agreement(it: Inspection, samples: Sequence[Sample], dofs: Sequence[int]) -> Iterator[Markup]:
    if it.agreement_known:
        yield tag("p", _largest_rhat(it))
        yield figures([_rhat_map(it)], "wide")
        yield tag("h3", "Rank plots")
        yield tag("p", RANKS)
        yield figures(rank_plot(it, sample, dof) for sample in samples for dof in dofs)
    else:
        yield tag("p", sentence(_no_agreement(it)))


def _close_ups(it: Inspection, worst: Sample, dofs: Sequence[int]) -> Iterator[Markup]:
    if not dofs:
        return
    which = "that disagree most" if it.agreement_known else "that are widest"
    yield tag("h3", f"Posterior of frame {worst.frame}")
    yield tag("p", f"The dofs {which}: for each run, a line, the share of its draws below each value. Lines that lie over one another agree.")
    yield figures(distribution_plot(it, worst, dof) for dof in dofs)
    yield tag("h3", "Growth of the effective sample size")
    yield tag("p", GROWTH)
    yield figures(growth_plot(it, worst, dof) for dof in dofs)


def _largest_rhat(it: Inspection) -> str:
    worst = worst_frame(it)
    values = np.nan_to_num(it.diagnosis.rhat[worst], nan=-np.inf)
    named = spoken(it.diagnosis.dofs[int(values.argmax())])
    largest = f"The largest is {values.max():.2f}: {named} at frame {worst}."
    return f"R-hat compares how far the runs lie apart with how wide each is; 1 is agreement. {largest}"


def _no_agreement(it: Inspection) -> str:
    if it.runs > 1:
        return "No R-hat exists here: there are too few draws, or no dof moves."
    return "With a single run there is no R-hat and there are no rank plots: nothing tells whether another run would agree. Take --runs 2 or more."


def _binned(values: Float[np.ndarray, "frame dof"]) -> Float[np.ndarray, "bin dof"]:
    """The largest of each bin of frames: none that disagrees shall fall between two pixels."""
    known = np.nan_to_num(values, nan=-np.inf)
    largest = np.stack([known[piece].max(axis=0) for piece in bins(len(values))])
    return np.where(np.isneginf(largest), np.nan, largest)


def _rhat_map(it: Inspection) -> Picture:
    """Dofs down, frames across."""
    from matplotlib.ticker import MultipleLocator

    frames, count = it.diagnosis.rhat.shape
    figure, axes = new_panel("R-hat", it.x_label, "", (4.2, 0.9 + 0.17 * count))
    set_margins(figure, 1.2, 0.42)
    axes.grid(visible=False)
    shown = axes.imshow(
        _binned(it.diagnosis.rhat).T,
        extent=(-0.5, frames - 0.5, count - 0.5, -0.5),
        aspect="auto",
        interpolation="nearest",
        cmap="Blues",
        vmin=1,
        vmax=max(2 * it.limits.rhat - 1, 1.2),
    )
    axes.set_yticks(range(count), [spoken(name) for name in it.diagnosis.dofs], fontsize=8.5)
    whole_frames(axes, frames)
    axes.set_xlim(-0.5, frames - 0.5)
    bar = figure.colorbar(shown, ax=axes, extend="max", pad=0.03, ticks=MultipleLocator(0.05), format="%.2f")
    bar.ax.axhline(it.limits.rhat, color=INK, linewidth=1.2)
    worst = float(np.nanmax(it.diagnosis.rhat))
    return encoded(
        figure,
        f"R-hat of every dof and frame, at most {worst:.2f}.",
        f"The colour grows with R-hat; the line on its scale is the limit {it.limits.rhat:g}.",
    )
