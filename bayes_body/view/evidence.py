"""Draw how the evidence for each model grows over the frames, as the difference to the best one."""

from pathlib import Path

import numpy as np

from bayes_body.base.errors import escaped
from bayes_body.results.evidence.comparison import Comparison
from bayes_body.view.colours import GREY, INK, run_line
from bayes_body.view.labels import label_lines
from bayes_body.view.picture.frame import SMALL, paper_style, save, wrapped

# Inches: the figure, and room for its axes' labels, its title and its text.
SIZE, LEFT, ABOVE, LINE = (7.0, 3.4), 0.75, 0.3, 0.15
TEXT = (
    "Lines are differences of log-evidences up to a frame, bands 95 % intervals of the Monte Carlo error. Above 0, the images up to there prefer "
    "the model to"
)


def write_comparison(comparison: Comparison, path: Path, size_px: int = 1600) -> None:
    """Write the picture.

    Args:
        comparison: the models.
        path: the file: .pdf, .svg or .png.
        size_px: longer side of a .png, pixels.

    Raises:
        InputError: the file has another suffix, or it cannot be written.
    """
    best, numbers = comparison.candidates[0].name, comparison.recording.first_frame + np.arange(comparison.frames)
    with paper_style():
        from matplotlib.figure import Figure

        text = wrapped(escaped(f"{TEXT} {best}. {comparison.recording.title}."), SIZE[0] - 0.1)
        below = LINE * (text.count("\n") + 1) + 0.6
        (width, height) = SIZE
        figure = Figure(figsize=SIZE)
        axes = figure.add_axes((LEFT / width, below / height, 1 - (LEFT + 0.15) / width, 1 - (below + ABOVE) / height))
        axes.axhline(0, color=GREY, linestyle=run_line(0), label=escaped(best))
        for number, (candidate, lead) in enumerate(zip(comparison.candidates[1:], comparison.differences[1:], strict=True), 1):
            axes.plot(
                numbers, np.where(np.isfinite(lead.value), lead.value, np.nan), color=INK, linestyle=run_line(number), label=escaped(candidate.name)
            )
            finite = np.isfinite(lead.low) & np.isfinite(lead.high)
            axes.fill_between(numbers, lead.low, lead.high, where=finite, color=GREY, alpha=0.25, linewidth=0)
        axes.set(title="Cumulative difference of log-evidence", xlabel="frame", ylabel=escaped(f"nats, relative to {best}"))
        axes.set_xlim(*(numbers[[0, -1]] if len(numbers) > 1 else numbers[0] + np.array([-0.5, 0.5])))
        label_lines(axes)
        figure.text(0.05 / width, 0.05 / height, text, fontsize=SMALL, va="bottom", color=INK, linespacing=1.3)
        save(figure, path, size_px / max(SIZE))
