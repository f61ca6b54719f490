"""The section on the agreement of the runs: R-hat of every dof and frame, and plots of the frames and dofs that agree least.

The map of R-hat has one row for each dof, with frames from left to right.
"""

from collections.abc import Iterator, Sequence

import numpy as np
from jaxtyping import Float

from bayes_body.view.colours import BAD, INK
from bayes_body.view.report.close_ups import arviz_plots, distribution_plot, forest_plot, growth_plot, rank_plot
from bayes_body.view.report.figures import bins, encoded, new_panel, set_margins, time_axis
from bayes_body.view.report.head import sentence
from bayes_body.view.report.inspection import Inspection, Sample, chosen_dofs, chosen_frames, equal_weight_sample, spoken, worst_frame
from bayes_body.view.report.markup import Markup, Picture, figures, section, tag


def dof_map(inspection: Inspection, rhat: Float[np.ndarray, "frame dof"], title: str, limit: float, alt: str, caption: str) -> Picture:
    """Return the map; a line on the colour scale marks the limit."""
    from matplotlib.ticker import MaxNLocator

    frames, count = rhat.shape
    figure, axes = new_panel(title, inspection.x_label, "", (4.2, 0.9 + 0.17 * count))
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
    axes.set_yticks(range(count), [spoken(name) for name in inspection.diagnosis.dofs], fontsize=8.5)
    time_axis(axes, frames, inspection.fps)
    axes.set_xlim(-0.5, frames - 0.5)
    bar = figure.colorbar(shown, ax=axes, extend="max", pad=0.03, ticks=MaxNLocator(5, steps=[1, 2, 5, 10]), format="%.2f")
    bar.ax.axhline(limit, color=INK, linewidth=1.2)
    return encoded(figure, alt, caption)


def _binned(values: Float[np.ndarray, "frame dof"]) -> Float[np.ndarray, "bin dof"]:
    """Return the largest value in each bin of frames, so that no single large value is lost between pixels."""
    filled = np.nan_to_num(values, nan=-np.inf)
    largest = np.stack([filled[piece].max(axis=0) for piece in bins(len(values))])
    return np.where(np.isneginf(largest), np.nan, largest)


RANKS = (
    "The draws of all runs are ranked together. Each line compares the ranks of one run with uniform ranks. If the runs agree, all lines stay inside "
    "the grey region in 95 of 100 cases. A line that leaves it belongs to a run that differs from the others: the line is high where the run's "
    "values are smaller, and low where they are larger."
)
GROWTH = (
    "ArviZ's effective sample size of the bulk and the tails as draws are added. It should grow in a straight line. The purple line marks 400 draws. "
    "The effective sample size depends on how much the runs differ, but not on whether the draws of one run share ancestors: compare it with the "
    "effective particles and the ancestors above."
)
SEEKER = (
    "The kernel is a mode seeker: the spread of its particles is not a measure of uncertainty, so no distributions and no intervals are shown. If "
    "the runs differ, the pose is doubtful. If they agree, the pose can still be wrong."
)
FOREST = (
    "Median and 90 % interval of each run's draws, relative to the median of all runs, which is written beside the name. The left side is blue, the "
    "right side orange, the middle green; each run has its line style. Short lines belong to joints that the recording determines well. If the "
    "lines of a joint lie apart, the runs disagree."
)


def run_section(inspection: Inspection) -> Markup:
    """Return the section: R-hat if there are several runs, and ArviZ's plots of the first, the worst and the last frame."""
    frames, dofs = chosen_frames(inspection), chosen_dofs(inspection)
    samples = [equal_weight_sample(inspection, frame) for frame in frames]
    worst = samples[frames.index(worst_frame(inspection))]
    with arviz_plots():
        parts = [*_agreement(inspection, samples, dofs)]
        if inspection.diagnosis.mode_seeker:
            return section("runs", "Agreement of the runs", tag("p", SEEKER), *parts)
        parts += _close_ups(inspection, worst, dofs)
        parts += (
            [tag("h3", "All angles"), tag("p", FOREST), figures(forest_plot(inspection, sample) for sample in samples)]
            if "°" in inspection.units
            else []
        )
    draws = ", ".join(f"{sample.poses.shape[1]} at frame {inspection.number(sample.frame)}" for sample in samples)
    about = f"Made by ArviZ from draws of equal weight. Their number per run follows from the effective sample size: {draws}."
    return section("runs", "Agreement of the runs", *parts, tag("p", about, class_="note"))


def _agreement(inspection: Inspection, samples: Sequence[Sample], dofs: Sequence[int]) -> Iterator[Markup]:
    if inspection.agreement_known:
        yield tag("p", _largest_rhat(inspection))
        yield figures([_rhat_map(inspection)], "wide")
        yield tag("h3", "Rank plots")
        yield tag("p", RANKS)
        yield figures(rank_plot(inspection, sample, dof) for sample in samples for dof in dofs)
    else:
        yield tag("p", sentence(_no_agreement(inspection)))


def _close_ups(inspection: Inspection, worst: Sample, dofs: Sequence[int]) -> Iterator[Markup]:
    if not dofs:
        return
    choice = "on which the runs disagree most" if inspection.agreement_known else "with the widest distributions"
    yield tag("h3", f"Posterior of frame {inspection.number(worst.frame)}")
    about = "Each line is a run, and shows the fraction of its draws below each value. If the runs agree, their lines coincide."
    yield tag("p", f"The dofs {choice}. {about}")
    yield figures(distribution_plot(inspection, worst, dof) for dof in dofs)
    yield tag("h3", "Growth of the effective sample size")
    yield tag("p", GROWTH)
    yield figures(growth_plot(inspection, worst, dof) for dof in dofs)


def _largest_rhat(inspection: Inspection) -> str:
    worst = worst_frame(inspection)
    values = np.nan_to_num(inspection.diagnosis.rhat[worst], nan=-np.inf)
    named = spoken(inspection.diagnosis.dofs[int(values.argmax())])
    largest = f"The largest is {values.max():.2f}: {named} at frame {inspection.number(worst)}."
    return f"R-hat compares the distance between the runs with the width of each run's posterior; 1 means agreement. {largest}"


def _no_agreement(inspection: Inspection) -> str:
    if inspection.runs > 1:
        return "There is no R-hat: there are too few draws, or no dof moves."
    return "With a single run there is no R-hat and there are no rank plots: it is unknown whether another run would agree. Use --runs 2 or more."


def _rhat_map(inspection: Inspection) -> Picture:
    return dof_map(
        inspection,
        inspection.diagnosis.rhat,
        "R-hat",
        inspection.limits.rhat,
        f"R-hat of every dof and frame, at most {np.nanmax(inspection.diagnosis.rhat):.2f}.",
        f"Darker is larger. The line on the colour scale is the limit {inspection.limits.rhat:g}.",
    )
