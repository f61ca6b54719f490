"""Warnings about the Markov chains of a run: the frames in which they did not mix, and what to change."""

from collections.abc import Iterator

import numpy as np

from bayes_body.results.posterior.diagnosis import Diagnosis, Thresholds
from bayes_body.results.posterior.frame_text import at_worst, frames_where, largest
from bayes_body.results.posterior.mixing import Mixing

# If chains disagree, smaller steps are recommended below this acceptance rate, and longer chains above it.
SMALLER_STEPS = 0.4


def mixing_sentences(diagnosis: Diagnosis, thresholds: Thresholds) -> Iterator[str]:
    """Yield a sentence for each limit that the chains cross; none if the kernel runs no Markov chains."""
    if diagnosis.mixing is None:
        return
    first = diagnosis.first_frame
    yield from _divergences(diagnosis.mixing, first, thresholds)
    yield from _disagreement(diagnosis.mixing, diagnosis.dofs, first, thresholds)
    yield from _energy(diagnosis.mixing, first, thresholds)


def _divergences(mixing: Mixing, first: int, thresholds: Thresholds) -> Iterator[str]:
    # Each state that is kept took at least one trajectory.
    trajectories = mixing.length * mixing.divergences.shape[-1]
    worst = mixing.divergences.sum(axis=-1).max(axis=0) / trajectories
    crossed = worst > thresholds.divergent_share
    if crossed.any():
        where = at_worst(crossed, first + int(worst.argmax()))
        figure = f"{worst.max():.0%} of the trajectories diverged{where} (limit {thresholds.divergent_share:.0%})"
        yield f"{frames_where(crossed, first)}: {figure}, so parts of the posterior may be missing; {_lower(mixing)}."


def _disagreement(mixing: Mixing, dofs: tuple[str, ...], first: int, thresholds: Thresholds) -> Iterator[str]:
    by_dof = np.where(np.isnan(mixing.rhat), -np.inf, mixing.rhat).max(axis=0)
    worst = largest(by_dof)
    crossed = worst > thresholds.markov_rhat
    if not crossed.any():
        return
    frame = int(worst.argmax())
    figure = f"R-hat up to {worst[frame]:.2f} ({dofs[int(by_dof[frame].argmax())]} at frame {first + frame}; limit {thresholds.markov_rhat:g})"
    accepted = float(mixing.acceptance[:, crossed].mean())
    remedy = (
        f"with {accepted:.2f} of the trajectories accepted, {_lower(mixing)}"
        if accepted < SMALLER_STEPS
        else "raise --leapfrog-steps or --particles, or --set burn_in=..., or --set starts=... if the chains are in different modes"
    )
    yield f"{frames_where(crossed, first)}: the chains of a frame did not mix, {figure}; {remedy}."


def _energy(mixing: Mixing, first: int, thresholds: Thresholds) -> Iterator[str]:
    worst = -largest(-mixing.energy_fraction.mean(axis=-1).T)
    crossed = worst < thresholds.energy_fraction
    if crossed.any():
        figure = f"E-BFMI {worst.min():.2f}{at_worst(crossed, first + int(worst.argmin()))} (limit {thresholds.energy_fraction:g})"
        meaning = "momenta change the energy too little to reach the tails"
        yield f"{frames_where(crossed, first)}: {meaning}, {figure}; raise --particles and --set burn_in=..."


def _lower(mixing: Mixing) -> str:
    return f"lower the step, for example with --set step={np.median(mixing.step) / 2:.2g}, or tune it with --set target_acceptance=0.8"
