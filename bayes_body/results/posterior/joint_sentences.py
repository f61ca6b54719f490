"""Warnings about paths that are drawn from one Gaussian of all frames: where it fits badly, and what to do instead."""

from collections.abc import Iterator

import numpy as np

from bayes_body.results.posterior.diagnosis import Diagnosis, Thresholds
from bayes_body.results.posterior.joint import JointFit
from bayes_body.results.posterior.mixing_sentences import at_worst, frames_where, largest

# Number of dofs that a sentence names; it only counts the rest.
MOST_DOFS = 6
BY_PATHS, BY_NUTS = "smooth with --start ensemble", "sample a window of frames by NUTS (inference/window.py)"


def joint_sentences(diagnosis: Diagnosis, thresholds: Thresholds) -> Iterator[str]:
    """Yield a sentence for each limit that is crossed; none for draws that come another way."""
    fit = diagnosis.joint
    if fit is None:
        return
    if not fit.converged.all():
        runs = ", ".join(str(1 + run) for run in np.flatnonzero(~fit.converged))
        yield f"the search for the Gaussian of all frames did not end within {fit.steps.max()} steps in run {runs}: do not use its paths; {BY_PATHS}."
    yield from _windows(fit, diagnosis.first_frame, thresholds)
    yield from _limits(fit, thresholds)


def _windows(fit: JointFit, first: int, thresholds: Thresholds) -> Iterator[str]:
    worst = largest(fit.pareto_k.T)
    crossed = worst > thresholds.pareto_k
    if np.isnan(fit.pareto_k).all():
        yield "too few paths for Pareto k, so nothing says how well the Gaussian of all frames fits; raise --draws."
    if not crossed.any():
        return
    share = 1 - fit.share_of_good_windows(thresholds.pareto_k)
    figure = f"Pareto k {worst.max():.2f}{at_worst(crossed, first + int(worst.argmax()))} (limit {thresholds.pareto_k:g})"
    problem = f"the Gaussian of all frames fits badly in windows about {share:.0%} of the frames, {figure}"
    yield f"{frames_where(crossed, first)}: {problem}; {BY_PATHS}, or {BY_NUTS}."


def _limits(fit: JointFit, thresholds: Thresholds) -> Iterator[str]:
    shares = {dof: share for dof, share in fit.near_limit_shares.items() if share > thresholds.near_limit_share}
    if not shares:
        return
    ordered = sorted(shares.items(), key=lambda item: -item[1])
    named = ", ".join(f"{dof} ({share:.0%} of the frames)" for dof, share in ordered[:MOST_DOFS])
    more = f" and {len(shares) - MOST_DOFS} more" if len(shares) > MOST_DOFS else ""
    problem = "within three standard deviations of a limit, where the Gaussian is too far from it, whatever Pareto k says"
    yield f"{named}{more}: {problem}; {BY_NUTS} to know these dofs."
