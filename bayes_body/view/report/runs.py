"""Whether the runs agree: R-hat of every dof and frame, and a closer look at a few."""

from collections.abc import Iterator, Sequence

import numpy as np

from bayes_body.view.report.choice import Sample, chosen_dofs, chosen_frames, equal_weight_sample, worst_frame
from bayes_body.view.report.close_ups import arviz_plots, distribution_plot, forest_plot, growth_plot, rank_plot
from bayes_body.view.report.dof_map import dof_map
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
SEEKER = (
    "The kernel is a mode seeker: the spread of its particles is no uncertainty, so no distributions and no intervals are shown. Runs that lie apart "
    "make the pose doubtful; runs that agree prove nothing."
)
FOREST = (
    "Median, middle half (thick) and 90 % (thin) of each run's draws, as their distance from the median of all runs, which stands beside the name: "
    "short lines are joints that the recording pins down, lines that lie apart are runs that disagree."
)


def run_section(it: Inspection) -> Markup:
    """R-hat where there are several runs, ArviZ's plots of the first, the worst and the last frame."""
    frames, dofs = chosen_frames(it), chosen_dofs(it)
    samples = [equal_weight_sample(it, frame) for frame in frames]
    worst = samples[frames.index(worst_frame(it))]
    with arviz_plots():
        parts = [*_agreement(it, samples, dofs)]
        if it.diagnosis.mode_seeker:
            return section("runs", "Do the runs agree?", tag("p", SEEKER), *parts)
        parts += _close_ups(it, worst, dofs)
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


def _rhat_map(it: Inspection) -> Picture:
    return dof_map(
        it,
        it.diagnosis.rhat,
        "R-hat",
        it.limits.rhat,
        f"R-hat of every dof and frame, at most {np.nanmax(it.diagnosis.rhat):.2f}.",
        f"The colour grows with R-hat; the line on its scale is the limit {it.limits.rhat:g}.",
    )
