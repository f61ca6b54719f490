"""The section on message passing: whether the particles of every part are enough, and convergence by iteration as in Sigal et al. 2011, Fig. 8."""

from collections.abc import Iterator
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float

from bayes_body.results.posterior.message_passing import PARTS, MessagePassing
from bayes_body.view.colours import GREY, INK, paper, run_line
from bayes_body.view.report.figures import draw_limit, encoded, log_counts, median_and_range, new_panel, point_marks
from bayes_body.view.report.inspection import Inspection, spoken
from bayes_body.view.report.markup import Markup, Picture, figures, section, tag
from bayes_body.view.report.panels import frame_panel, run_panel

if TYPE_CHECKING:
    from matplotlib.axes import Axes

ABOUT = (
    "Every part has particles of its own, and its belief is what the images and the messages from other parts say about it. In each iteration the "
    "particles are drawn anew. Joint draws of all parts are taken at the end; their effective number is in the section on the filter."
)
CONVERGENCE = (
    "How far the mean of a part's belief moved in an iteration, in standard deviations of that belief. The lines should fall below the limit "
    "(purple), to the level that the random draws of the particles alone cause (dotted), and stay there. The parts that moved most in the last "
    "iteration have the colour of their side and a name. The spread of a belief should settle too: one that goes on shrinking has not converged, or "
    "rests on few particles."
)
SHARES = (
    "Where the particles that carry the weight came from, mean over the parts. If the fit to the last belief brings nearly all of it, the messages "
    "and the prior propose little that the images confirm, and the search is local."
)
# Number of parts that are named in a picture.
SHOWN = 3
MILLIMETRES = 1000.0


def message_section(inspection: Inspection) -> Markup:
    """Return the section: figures over the frames, and the iterations of a few frames."""
    passing = inspection.diagnosis.messages
    if passing is None:
        return section("messages", "Message passing", tag("p", "The kernel passes no messages."))
    parts = [tag("p", ABOUT), figures(_panels(inspection, passing)), tag("p", SHARES), figures([_shares(inspection, passing)])]
    if passing.change.shape[2] > 1:
        parts += [tag("h3", "Convergence by iteration"), tag("p", CONVERGENCE), figures(_changes(inspection, passing))]
        parts += [figures(_spreads(inspection, passing))] if "m" in passing.units else []
    return section("messages", "Message passing", *parts)


def chosen_frames(passing: MessagePassing) -> list[int]:
    """Return the first frame, the last one, and that with the largest change in the last iteration, without repetition."""
    worst = np.nan_to_num(passing.last_change, nan=-np.inf).max(axis=(0, 2))
    return sorted({0, int(worst.argmax()), len(worst) - 1})


def _panels(inspection: Inspection, passing: MessagePassing) -> Iterator[Picture]:
    limits, samples = inspection.limits, passing.samples
    counted = f"of {samples:,} (log scale)"
    yield _panel(inspection, passing.belief_ess.min(axis=-1), "Effective particles of a belief", counted, limits.belief_ess_share * samples, samples)
    yield _panel(inspection, passing.message_ess, "Effective particles of a message", counted, limits.message_ess_share * samples, samples)
    if np.isfinite(passing.last_change).any():
        yield _panel(inspection, passing.last_change.max(axis=-1), "Change in the last iteration", "sd of the belief", limits.message_change)
    if np.isfinite(passing.oscillation).any():
        yield _panel(inspection, passing.oscillation.max(axis=-1), "Oscillation", "sd of the belief", limits.oscillation)


def _panel(inspection: Inspection, values: Float[np.ndarray, "run frame"], title: str, label: str, limit: float, most: int | None = None) -> Picture:
    """Return the worst part of every frame; with `most`, as a count up to it."""
    figure, axes = run_panel(inspection, title, label, values)
    draw_limit(axes, limit)
    if most is None:
        axes.set_ylim(0, 1.15 * max(limit, float(np.nanmax(values))))
    else:
        log_counts(axes, most)
    return encoded(figure, f"{title} over the frames, the worst part of each: {median_and_range(values)}; the limit is {limit:g}.")


def _shares(inspection: Inspection, passing: MessagePassing) -> Picture:
    mean = passing.proposal_shares.mean(axis=(0, 2))
    figure, axes = frame_panel(inspection, "Parts of the proposal", inspection.x_label, "share of the weight")
    brought = [number for number in range(len(PARTS)) if np.nanmax(mean[:, number]) > 0]
    for number in brought:
        axes.plot(mean[:, number], color=INK, linestyle=run_line(number), label=PARTS[number], **point_marks(len(mean)))
    axes.set_ylim(-0.03, 1.03)
    named = ", ".join(f"{PARTS[number]} {np.nanmean(mean[:, number]):.2f}" for number in brought)
    return encoded(figure, f"Share of each part of the proposal in the weight of the particles, mean over the frames: {named}.")


def _changes(inspection: Inspection, passing: MessagePassing) -> Iterator[Picture]:
    """Yield the changes of the beliefs by iteration, mean of the runs, at each chosen frame."""
    from matplotlib.ticker import LogLocator, NullFormatter

    for frame in chosen_frames(passing):
        change = passing.change[:, frame].mean(axis=0)
        figure, axes = new_panel(f"Change, frame {inspection.number(frame)}", "iteration", "sd of the belief (log scale)")
        worst = _by_part(axes, change, passing, _moved_most(passing, frame))
        draw_limit(axes, inspection.limits.message_change)
        axes.axhline(float(np.sqrt(2 / np.median(passing.belief_ess[:, frame]))), color=INK, linestyle=":", linewidth=1.1)
        axes.set_yscale("log")
        axes.yaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
        axes.yaxis.set_major_formatter("{x:g}")
        axes.yaxis.set_minor_formatter(NullFormatter())
        yield encoded(figure, f"Change of the beliefs in each iteration of frame {inspection.number(frame)}; in the last one most of {worst}.")


def _spreads(inspection: Inspection, passing: MessagePassing) -> Iterator[Picture]:
    """Yield the spread of the positions by iteration, mean of the runs, at each chosen frame."""
    metres = np.array([unit == "m" for unit in passing.units])
    for frame in chosen_frames(passing):
        spread = MILLIMETRES * np.sqrt(np.mean(passing.sd[:, frame][..., metres] ** 2, axis=(0, -1)))
        figure, axes = new_panel(f"Spread of the positions, frame {inspection.number(frame)}", "iteration", "sd, mm")
        _by_part(axes, spread, passing, _moved_most(passing, frame))
        span = f"from {spread.min():.0f} to {spread.max():.0f} mm"
        axes.set_ylim(0, 1.05 * spread.max())
        yield encoded(figure, f"Standard deviation of each part's position in frame {inspection.number(frame)}, {span}.")


def _moved_most(passing: MessagePassing, frame: int) -> list[int]:
    """Return the nodes, those first whose belief moved most in the last iteration of a frame."""
    last = passing.last_change[:, frame].mean(axis=0)
    return np.argsort(-np.nan_to_num(last, nan=-np.inf), kind="stable").tolist()


def _by_part(axes: "Axes", values: Float[np.ndarray, "iteration node"], passing: MessagePassing, order: list[int]) -> str:
    """Draw a line for each part, and name the first ones, which are returned in words."""
    from matplotlib.ticker import MaxNLocator

    numbers = np.arange(1, len(values) + 1)
    for node in order[SHOWN:]:
        axes.plot(numbers, values[:, node], color=GREY, alpha=0.5, linewidth=0.9)
    for number, node in enumerate(order[:SHOWN]):
        name = passing.nodes[node]
        axes.plot(numbers, values[:, node], color=paper(name), linestyle=run_line(number), marker="o", markersize=3, label=spoken(name))
    axes.xaxis.set_major_locator(MaxNLocator(6, integer=True, min_n_ticks=1))
    axes.set_xlim(0.7, len(values) + 0.3)
    return ", ".join(spoken(passing.nodes[node]) for node in order[:SHOWN])
