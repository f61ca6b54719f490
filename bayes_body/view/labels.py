"""Names of lines at their ends instead of a legend: a reader need not look from one to the other and back."""

from collections.abc import Sequence
from typing import TYPE_CHECKING, cast

import numpy as np
from matplotlib.lines import Line2D

if TYPE_CHECKING:
    from matplotlib.axes import Axes

# Points: length of the sample of a line before its name, room around it, and distance of two names, in heights of their letters.
SAMPLE, GAP, LEADING = 15.0, 3.0, 1.15
POINTS_AN_INCH = 72


def label_lines(axes: "Axes", size: float = 8.5) -> None:
    """Write the label of every line at the line's right end, after a sample of the line, and make room for it on the right of the axes.

    Names that would overlap are moved apart, in the order of the lines' ends. Call it when limits, scale and margins of the axes are set.

    Args:
        axes: the axes, whose figure has a fixed layout; lines without a label are left out.
        size: height of the letters, points.
    """
    from matplotlib.textpath import TextPath

    handles, names = axes.get_legend_handles_labels()
    # An errorbar is a tuple, with its line first.
    lines = [handle if isinstance(handle, Line2D) else cast("Sequence[Line2D]", handle)[0] for handle in handles]
    if not lines:
        return
    figure = axes.get_figure(root=True)
    assert figure is not None
    widest = max(TextPath((0, 0), name, size=size).get_extents().width for name in names)
    _make_room(axes, SAMPLE + 3 * GAP + widest)
    width, height = (POINTS_AN_INCH * side for side in axes.get_position().size * figure.get_size_inches())
    ends = [_end(axes, line) for line in lines]
    for line, name, place in zip(lines, names, spread(ends, LEADING * size / height), strict=True):
        start, stop = 1 + GAP / width, 1 + (GAP + SAMPLE) / width
        sample = Line2D([start, stop], [place, place])
        # With the line's dashes.
        sample.update_from(line)
        sample.set(transform=axes.transAxes, clip_on=False, marker="", label="")
        axes.add_line(sample)
        axes.text(stop + GAP / width, place, name, transform=axes.transAxes, color=line.get_color(), fontsize=size, va="center", clip_on=False)


def _make_room(axes: "Axes", points: float) -> None:
    figure = axes.get_figure(root=True)
    assert figure is not None
    place = axes.get_position()
    axes.set_position((place.x0, place.y0, place.width - points / POINTS_AN_INCH / figure.get_size_inches()[0], place.height))


def _end(axes: "Axes", line: Line2D) -> float:
    """Return the height of a line's last known point, as a fraction of the axes."""
    x, y = (np.asarray(values, float) for values in line.get_data(orig=False))
    finite_places = np.flatnonzero(np.isfinite(x) & np.isfinite(y))
    if not finite_places.size:
        return 0.5
    point = axes.transData.transform((x[finite_places[-1]], y[finite_places[-1]]))
    return float(np.clip(axes.transAxes.inverted().transform(point)[1], 0, 1))


def spread(heights: Sequence[float], gap: float) -> list[float]:
    """Return heights near these, in the same order and at least `gap` apart, inside 0 to 1 if there is room.

    It is the closest such list in the sense of least squares (pool adjacent violators), moved into the axes as a whole.
    """
    order = np.argsort(heights, kind="stable")
    blocks: list[list[float]] = []
    for rank, place in enumerate(order):
        blocks.append([heights[place] - rank * gap])
        while len(blocks) > 1 and np.mean(blocks[-2]) > np.mean(blocks[-1]):
            blocks[-2:] = [blocks[-2] + blocks[-1]]
    level = np.concatenate([np.full(len(block), np.mean(block)) for block in blocks]) + gap * np.arange(len(order))
    level -= max(level[-1] - 1, 0)
    level += max(-level[0], 0)
    out = np.empty(len(order))
    out[order] = level
    return out.tolist()
