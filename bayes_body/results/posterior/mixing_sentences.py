"""Warnings about a run's Markov chains and message passing: the frames that are affected, and what to change.

Markov chains may not mix in a frame. Message passing may have too few particles there, or its iterations may not converge. All sentences about frames
share their wording.
"""

from collections.abc import Iterator, Sequence

import numpy as np
from jaxtyping import Bool, Float

from bayes_body.results.posterior.diagnosis import Diagnosis, Thresholds
from bayes_body.results.posterior.message_passing import MessagePassing
from bayes_body.results.posterior.mixing import Mixing

# Number of stretches of frames that a sentence names; it only counts the rest.
MOST_STRETCHES = 6


def frame_ranges(frames: Sequence[int], most: int = MOST_STRETCHES) -> str:
    """Return ascending frames in words, such as `frame 3` or `frames 3-7, 9`; beyond `most` stretches the rest is only counted."""
    stretches: list[list[int]] = []
    for frame in frames:
        if stretches and stretches[-1][1] == frame - 1:
            stretches[-1][1] = frame
        else:
            stretches.append([frame, frame])
    named = ", ".join(str(first) if first == last else f"{first}-{last}" for first, last in stretches[:most])
    remainder = sum(last - first + 1 for first, last in stretches[most:])
    return f"frame{'s' if len(frames) > 1 else ''} {named}{f' and {remainder} more' if remainder else ''}"


def frames_where(crossed: Bool[np.ndarray, " frame"], first: int) -> str:
    """Return the frames that cross a limit, in words; `first` is the number of the first frame."""
    return frame_ranges((first + np.flatnonzero(crossed)).tolist())


def largest(values: Float[np.ndarray, "frame k"]) -> Float[np.ndarray, " frame"]:
    """Return the largest value of each row; -∞ if it has none."""
    return np.where(np.isnan(values), -np.inf, values).max(axis=1)


def at_worst(crossed: Bool[np.ndarray, " frame"], number: int) -> str:
    """Return words that name the worst frame; empty if only one frame crosses the limit."""
    return f" at worst, at frame {number}" if crossed.sum() > 1 else ""


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
        place = at_worst(crossed, first + int(worst.argmax()))
        figure = f"{worst.max():.0%} of the trajectories diverged{place} (limit {thresholds.divergent_share:.0%})"
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


# Particles alone change a mean by about sqrt(2 / ESS) standard deviations. A change within this multiple of it calls for more particles.
NOISE = 2.0


def message_sentences(diagnosis: Diagnosis, thresholds: Thresholds) -> Iterator[str]:
    """Yield a sentence for each limit that message passing crosses; none if the kernel passes no messages."""
    figures = diagnosis.messages
    if figures is None:
        return
    first = diagnosis.first_frame
    yield from _joint(figures, diagnosis.particles, first, thresholds)
    yield from _beliefs(figures, first, thresholds)
    yield from _messages(figures, first, thresholds)
    yield from _oscillation(figures, first, thresholds)
    yield from _change(figures, first, thresholds)


def _joint(figures: MessagePassing, draws: int, first: int, thresholds: Thresholds) -> Iterator[str]:
    worst = figures.joint_ess.min(axis=0)
    crossed = worst < min(thresholds.joint_ess, draws)
    if crossed.any():
        place = at_worst(crossed, first + int(worst.argmin()))
        figure = f"{worst.min():.1f} effective joint draws of {draws}{place} (limit {thresholds.joint_ess:g})"
        reason = "the messages leave out too much of the model, such as factors that close loops or read the whole body"
        remedy = f"take likelihoods of single parts, such as regions, {_more(figures)}, or use --kernel tempered"
        yield f"{frames_where(crossed, first)}: {figure}: {reason}; {remedy}."


def _beliefs(figures: MessagePassing, first: int, thresholds: Thresholds) -> Iterator[str]:
    by_node = figures.belief_ess.min(axis=0)
    worst, limit = by_node.min(axis=1), thresholds.belief_ess_share * figures.samples
    crossed = worst < limit
    if crossed.any():
        frame, name = _place(figures, -by_node)
        rests = f"rests on {worst.min():.1f} effective particles of {figures.samples}{at_worst(crossed, first + frame)}"
        figure = f"the belief of {name} {rests} (limit {limit:g})"
        yield f"{frames_where(crossed, first)}: {figure}; {_more(figures)}, or change the shares of the proposal, --set shares=..."


def _messages(figures: MessagePassing, first: int, thresholds: Thresholds) -> Iterator[str]:
    worst, limit = figures.message_ess.min(axis=0), thresholds.message_ess_share * figures.samples
    crossed = worst < limit
    if crossed.any():
        figure = f"a message rests on {worst.min():.1f} effective particles of {figures.samples}{at_worst(crossed, first + int(worst.argmin()))}"
        yield f"{frames_where(crossed, first)}: {figure} (limit {limit:g}); {_more(figures)}."


def _oscillation(figures: MessagePassing, first: int, thresholds: Thresholds) -> Iterator[str]:
    by_node = _largest_of_runs(figures.oscillation)
    worst = by_node.max(axis=1)
    crossed = worst > thresholds.oscillation
    if crossed.any():
        frame, name = _place(figures, by_node)
        jumps = f"jumps back and forth by {worst.max():.1f} sd{at_worst(crossed, first + frame)}"
        figure = f"the belief of {name} {jumps} (limit {thresholds.oscillation:g})"
        remedy = f"try --set 'schedule=\"tree\"', in which neighbours do not move at once, or {_more(figures)}"
        yield f"{frames_where(crossed, first)}: {figure}: messages around a loop do not converge; {remedy}."


def _change(figures: MessagePassing, first: int, thresholds: Thresholds) -> Iterator[str]:
    by_node = _largest_of_runs(figures.last_change)
    worst = by_node.max(axis=1)
    crossed = worst > thresholds.message_change
    if crossed.any():
        frame, name = _place(figures, by_node)
        figure = f"the belief of {name} still moved by {worst.max():.1f} sd in the last iteration{at_worst(crossed, first + frame)}"
        iterations = figures.change.shape[2]
        noise = NOISE * np.sqrt(2 / figures.belief_ess[:, crossed])
        if (figures.last_change[:, crossed] <= noise).all():
            remedy = f"so much is the noise of its few effective particles; {_more(figures)}"
        else:
            remedy = f"it has not converged; raise the iterations, --set iterations={2 * iterations}"
        yield f"{frames_where(crossed, first)}: {figure} (limit {thresholds.message_change:g}): {remedy}."


def _more(figures: MessagePassing) -> str:
    return f"raise the particles of each part, --set samples={2 * figures.samples}"


def _largest_of_runs(values: Float[np.ndarray, "run frame node"]) -> Float[np.ndarray, "frame node"]:
    return np.where(np.isnan(values), -np.inf, values).max(axis=0)


def _place(figures: MessagePassing, values: Float[np.ndarray, "frame node"]) -> tuple[int, str]:
    """Return the frame with the largest value, and the name of the node that has it."""
    frame, node = np.unravel_index(int(values.argmax()), values.shape)
    return int(frame), figures.nodes[int(node)]
