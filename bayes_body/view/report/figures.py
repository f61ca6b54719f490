"""Style of the report's plots, and their encoding for the page: as SVG, or as PNG where that is smaller.

Plots are small, with one panel each. They stand side by side on a wide screen and below each other on a narrow one, without shrinking. They are
drawn in dark ink on a transparent background, and a dark page inverts them. Colours and lines are those of view/colours.py; a line that has a label
has it at its end.
"""

import base64
import io
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
from cv2.typing import MatLike
from jaxtyping import Bool, Float
from numpy.typing import NDArray

from bayes_body.view.colours import INK, WARNING, run_line
from bayes_body.view.labels import label_lines
from bayes_body.view.report.markup import Picture

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

PANEL = (3.6, 2.5)
# With more runs than this, their names would not fit beside a plot.
NAMED = 6
# Margins around the axes in inches: left, right, bottom, top. They are the same in all panels, so that the axes are aligned.
MARGINS = (0.66, 0.14, 0.5, 0.28)
# With more points on a line than this, several frames share a point; above this number of bytes of an SVG, a PNG is tried.
MOST_POINTS, LARGE_SVG = 400, 50_000
STYLE: Any = {
    "axes.axisbelow": True,
    "axes.edgecolor": INK,
    "axes.grid": True,
    "axes.labelcolor": INK,
    "axes.labelsize": 9,
    "axes.prop_cycle": f"cycler('color', ['{INK}'])",
    "axes.spines.right": False,
    "axes.spines.top": False,
    "axes.titlelocation": "left",
    "axes.titlesize": 10,
    "axes.titleweight": "bold",
    "font.family": "DejaVu Sans",
    "font.size": 9,
    "grid.alpha": 0.3,
    "grid.linewidth": 0.6,
    "legend.fontsize": 8.5,
    "legend.frameon": False,
    "lines.linewidth": 1.3,
    "path.simplify_threshold": 0.5,
    "savefig.transparent": True,
    # Makes the page reproducible: the same run gives the same page.
    "svg.hashsalt": "bayes_body",
    # A dollar sign in a name is one, not the beginning of a formula.
    "text.parse_math": False,
    "xtick.labelsize": 8.5,
    "ytick.labelsize": 8.5,
}


@contextmanager
def style() -> Iterator[None]:
    """Within it, plots have the report's style."""
    import matplotlib as mpl

    with mpl.rc_context(STYLE):
        yield


def new_panel(title: str, x: str, y: str, size: tuple[float, float] = PANEL) -> "tuple[Figure, Axes]":
    """Return an empty panel: a figure without a window and without pyplot's global state."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=size)
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    axes.set(title=title, xlabel=x, ylabel=y)
    set_margins(figure)
    return figure, axes


def set_margins(figure: "Figure", left: float = MARGINS[0], right: float = MARGINS[1]) -> None:
    """Leave room around the axes for their labels, `left` and `right` in inches."""
    (width, height), (_, _, bottom, top) = figure.get_size_inches(), MARGINS
    figure.subplots_adjust(left=left / width, right=1 - right / width, bottom=bottom / height, top=1 - top / height)


def log_counts(axes: "Axes", most: int) -> None:
    """Set a logarithmic scale for counts from 1 to `most`, with numbers written out."""
    from matplotlib.ticker import NullFormatter

    axes.set_yscale("log")
    axes.set_ylim(0.8, most * 1.3)
    axes.yaxis.set_major_formatter("{x:,.0f}")
    axes.yaxis.set_minor_formatter(NullFormatter())


def log_values(axes: "Axes") -> None:
    """Set a logarithmic scale with numbers written out. If the plot spans less than a power of ten, minor ticks have numbers too."""
    from matplotlib.ticker import NullFormatter

    axes.set_yscale("log")
    low, high = axes.get_ylim()
    axes.yaxis.set_major_formatter("{x:g}")
    axes.yaxis.set_minor_formatter("{x:g}" if high < 10 * low else NullFormatter())
    axes.tick_params(axis="y", which="minor", labelsize=8.5)


def encoded(figure: "Figure", alt: str, caption: str = "") -> Picture:
    """Return the figure as a picture for the page, with names at the ends of lines that have any and no legend."""
    for axes in figure.axes:
        if axes.get_legend() is None:
            label_lines(axes)
    image = io.BytesIO()
    figure.savefig(image, format="svg", metadata={"Date": None})
    kind = "svg+xml"
    if image.tell() > LARGE_SVG:
        pixels = io.BytesIO()
        figure.savefig(pixels, format="png", dpi=2 * 96)
        if pixels.tell() < image.tell():
            image, kind = pixels, "png"
    return Picture(data_uri(f"image/{kind}", image.getvalue()), alt, caption)


def data_uri(kind: str, content: bytes) -> str:
    """Return a `data:` URI that contains the content."""
    return f"data:{kind};base64,{base64.b64encode(content).decode()}"


def webp_uri(image: MatLike, quality: int) -> str:
    """Return a `data:` URI of an image as WebP; `quality` is up to 100."""
    return data_uri("image/webp", cv2.imencode(".webp", image, [cv2.IMWRITE_WEBP_QUALITY, quality])[1].tobytes())


def median_and_range(values: NDArray[np.floating]) -> str:
    """Return for example `median 0.8, from 0.7 to 0.95`, of the values that are known."""
    return f"median {np.nanmedian(values):.3g}, from {np.nanmin(values):.3g} to {np.nanmax(values):.3g}"


def draw_runs(axes: "Axes", frames: NDArray[np.integer], values: Float[np.ndarray, "run frame"]) -> None:
    """Draw one line for each run over the frames. If frames share points, draw each bin's median, and a band from its minimum to its maximum."""
    binned = bins(len(frames))
    for run, line in enumerate(values):
        style = {"color": INK, "linestyle": run_line(run), "label": run_label(run, len(values))}
        if len(binned) == len(frames):
            axes.plot(frames, line, **style, **point_marks(len(frames)))
            continue
        low, middle, high = (np.array([_statistic(piece, line[part]) for part in binned]) for piece in (np.min, np.median, np.max))
        starts = frames[[part.start for part in binned]]
        axes.fill_between(starts, low, high, color=INK, alpha=0.2, linewidth=0)
        axes.plot(starts, middle, **style)


def run_label(run: int, runs: int) -> str | None:
    """Return the name of a run's line; None for a single run, and for so many that their names would not fit."""
    return f"run {run + 1}" if 1 < runs <= NAMED else None


def draw_limit(axes: "Axes", value: float, name: str = "limit") -> None:
    """Draw a limit as a purple line across the axes, with its name on it."""
    axes.axhline(value, color=WARNING, linewidth=1.1)
    place = {"xycoords": axes.get_yaxis_transform(), "textcoords": "offset points", "ha": "right", "va": "bottom"}
    axes.annotate(name, (0.995, value), xytext=(0, 1), color=WARNING, fontsize=8, **place)


def _statistic(piece: Callable[..., np.floating], values: NDArray[np.floating]) -> float:
    finite = values[np.isfinite(values)]
    return float(piece(finite)) if finite.size else float("nan")


def point_marks(frames: int) -> dict[str, Any]:
    """Return the marks of a line over that many frames: a line through two or three is hard to see without them, and a single frame has no line."""
    return {"marker": "o", "markersize": 3.5} if frames <= 12 else {}


def frames_a_point(frames: int) -> int:
    """Return the number of frames that share a point of a line."""
    return -(-frames // MOST_POINTS)


def bins(frames: int) -> Sequence[slice]:
    """Return the frames in at most MOST_POINTS slices of equal length; the last one can be shorter."""
    size = frames_a_point(frames)
    return [slice(start, min(start + size, frames)) for start in range(0, frames, max(size, 1))]


def time_label(fps: float | None, thinned: str = "") -> str:
    """Return the label of an axis of time, in seconds if the rate of the frames is known, and how the frames are thinned."""
    return ("time, s" if fps else "frame") + (f"; {thinned}" if thinned else "")


def shade_lost(axes: "Axes", lost: Bool[np.ndarray, " frame"], step: float = 1.0) -> None:
    """Shade the lost frames over the whole height of the axes; `step` is the distance between two frames on the axis."""
    from matplotlib.collections import PolyCollection

    edges = (np.flatnonzero(np.diff(np.concatenate([[0], lost.astype(int), [0]]))) - 0.5) * step
    spans = [[(start, 0), (stop, 0), (stop, 1), (start, 1)] for start, stop in edges.reshape(-1, 2)]
    # One artist for all spans: hundreds of `axvspan` took half of a long report's time.
    axes.add_collection(PolyCollection(spans, transform=axes.get_xaxis_transform(), color=WARNING, alpha=0.28, linewidth=0), autolim=False)


def time_axis(axes: "Axes", frames: int, fps: float | None) -> None:
    """Number an axis of frames in seconds, or in frames if their rate is unknown, and leave no empty margin."""
    from matplotlib.ticker import MaxNLocator

    if fps and frames > 1:
        seconds = np.asarray(MaxNLocator(5, steps=[1, 2, 5, 10]).tick_values(0, (frames - 1) / fps))
        axes.set_xticks(seconds * fps, [f"{second:g}" for second in seconds])
    else:
        axes.xaxis.set_major_locator(MaxNLocator(6, integer=True, min_n_ticks=1))
    axes.set_xlim(-0.5 if frames <= 12 else 0, frames - 0.5 if frames <= 12 else frames - 1)
