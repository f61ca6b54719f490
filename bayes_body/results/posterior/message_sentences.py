"""Warnings about message passing: frames with too few particles, or in which the iterations did not converge, and what to change."""

from collections.abc import Iterator

import numpy as np
from jaxtyping import Float

from bayes_body.results.posterior.diagnosis import Diagnosis, Thresholds
from bayes_body.results.posterior.frame_text import at_worst, frames_where
from bayes_body.results.posterior.message_passing import MessagePassing

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
        where = at_worst(crossed, first + int(worst.argmin()))
        figure = f"{worst.min():.1f} effective joint draws of {draws}{where} (limit {thresholds.joint_ess:g})"
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
