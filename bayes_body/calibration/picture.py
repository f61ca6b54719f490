"""Plot the ranks of each quantity: the difference between their distribution function and the uniform one, with its band."""

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from bayes_body.calibration import bands
from bayes_body.calibration.check import Findings
from bayes_body.calibration.verdict import FAMILY, curve, ranked_quantities
from bayes_body.files.atomic import replacing

COLUMNS = 4
INSIDE, OUTSIDE, BAND = "#1f5f8b", "#b3261e", "#cfd8dc"


def draw_ranks(findings: Findings, bins: int, path: Path, title: str) -> None:
    """Draw one panel per quantity.

    Args:
        findings: the replications' figures.
        bins: number of bins of the ranks.
        path: the picture; its suffix gives the format.
        title: title above all panels.

    Raises:
        InputError: the file cannot be written.
    """
    places = ranked_quantities(findings)
    counts = bands.rank_counts(findings.ranks["ranks"][:, places], bins)
    band = bands.bands(int(counts[0].sum()), bins, bands.family_level(len(places), FAMILY))
    limit, p = (1 - FAMILY) / len(places), bands.p_values(counts)
    rows = -(-len(places) // COLUMNS)
    figure = Figure(figsize=(3.0 * COLUMNS, 2.1 * rows + 0.9), layout="constrained")
    axes = figure.subplots(rows, COLUMNS, sharex=True, sharey=True, squeeze=False)
    for axis, place, ranked, value in zip(axes.flat, places, counts, p, strict=False):
        _panel(axis, findings.names[place], ranked, band, float(value), bool(value > limit))
    for axis in list(axes.flat)[len(places) :]:
        axis.set_visible(False)
    for axis in list(axes.flat)[max(len(places) - COLUMNS, 0) : len(places)]:
        axis.tick_params(labelbottom=True)
    figure.suptitle(title, fontsize=11)
    figure.supxlabel("posterior level of the truth", fontsize=9)
    figure.supylabel("fraction of truths below, minus the level", fontsize=9)
    with replacing(path) as partial:
        figure.savefig(partial, dpi=110)


def _panel(axis: Axes, name: str, counts: NDArray[np.integer], band: bands.Bands, p: float, inside: bool) -> None:
    ends = np.array([0.0])
    points = np.concatenate([ends, band.points, ends + 1])
    low, high, ranked = (np.concatenate([ends, side - band.points, ends]) for side in (band.low, band.high, curve(counts)))
    axis.fill_between(points, low, high, color=BAND, linewidth=0)
    axis.axhline(0, color="white", linewidth=1)
    axis.plot(points, ranked, color=INSIDE if inside else OUTSIDE, linewidth=1.6)
    axis.set_title(f"{name}   p = {p:.2g}", fontsize=9, color="black" if inside else OUTSIDE)
    axis.tick_params(labelsize=8)
    axis.set_xlim(0, 1)
