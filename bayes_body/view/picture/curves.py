"""Curves of angles and positions over time: mean and 90 % interval of all runs together, both sides of a joint in one panel."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from jaxtyping import Float

from bayes_body.base.errors import input_error, nearest
from bayes_body.results.clinical.conventions import CLINICAL
from bayes_body.view.colours import INK, paper, side_of
from bayes_body.view.colours import NAMES as SIDES
from bayes_body.view.export.motion import lost_frames
from bayes_body.view.labels import label_lines
from bayes_body.view.picture.frame import SMALL, made_of, paper_style, save, wrapped
from bayes_body.view.report.bands import LEAST_SPAN, draw_band, limits
from bayes_body.view.report.curves import clinical_curves, dof_curves, units_of
from bayes_body.view.report.figures import shade_lost
from bayes_body.view.report.inspection import spoken

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from bayes_body.results.storage.saved_run import SavedRun

# Inches: a panel, margins on the left, below and above its axes, and a line of the text. Most panels in a row.
PANEL, LEFT, BELOW, ABOVE, LINE, COLUMNS = (3.5, 2.3), 0.62, 0.46, 0.28, 0.15, 2
BANDS = "Lines are means, bands 90 % intervals of the posterior, all runs together."
SEEKER = "Lines are means of the particles. The spread of a mode seeker's particles is not a measure of uncertainty."


class Curve(NamedTuple):
    """Mean and 90 % interval over the frames, in degrees or metres."""

    unit: str
    mean: Float[np.ndarray, " frame"]
    low: Float[np.ndarray, " frame"]
    high: Float[np.ndarray, " frame"]


def write_curves(run: "SavedRun", path: Path, names: Sequence[str], size_px: int = 2000) -> None:
    """Write curves over time, in seconds.

    Args:
        run: the run, loaded from its folder.
        path: the file: .pdf, .svg or .png.
        names: dofs such as `l_knee` and clinical angles such as `knee_flexion_l`. A name without its side is both sides.
        size_px: longer side of a .png, pixels.

    Raises:
        InputError: the run has no such curve, or the picture cannot be written.
    """
    run_curves = curves_of(run)
    if not names:
        raise input_error("--curves", "no name", f"names among {', '.join(run_curves)}", "name one or more, with commas between them")
    panels: dict[str, list[str]] = {}
    for name in names:
        for curve_name in _sides(name, run_curves):
            members = panels.setdefault(base(curve_name), [])
            members += [curve_name] if curve_name not in members else []
    with paper_style():
        from matplotlib.figure import Figure

        columns = min(COLUMNS, len(panels))
        rows = -(-len(panels) // columns)
        text = wrapped(f"{SEEKER if run.mode_seeker else BANDS} {made_of(run)}.", columns * PANEL[0] - 0.1)
        below = LINE * (text.count("\n") + 1) + 0.1
        width, height = columns * PANEL[0], rows * PANEL[1] + below
        figure = Figure(figsize=(width, height))
        for number, members in enumerate(panels.values()):
            row, column = divmod(number, columns)
            corner = column * PANEL[0] + LEFT, height - (row + 1) * PANEL[1] + BELOW
            size = PANEL[0] - LEFT - 0.12, PANEL[1] - BELOW - ABOVE
            axes = figure.add_axes((corner[0] / width, corner[1] / height, size[0] / width, size[1] / height))
            _draw(axes, run, {name: run_curves[name] for name in members})
        figure.text(0.05 / width, 0.05 / height, text, fontsize=SMALL, va="bottom", color=INK, linespacing=1.3)
        save(figure, path, size_px / max(figure.get_size_inches()))


def curves_of(run: "SavedRun") -> Mapping[str, Curve]:
    """Return every dof's and clinical angle's curve by name."""
    frames = range(run.frames)
    labels = [label for space in run.spaces.values() for label in space.tangent_labels]
    angles = clinical_curves(run, frames)
    curves = {}
    for names, units, moments in ((labels, units_of(run), dof_curves(run, frames)), (angles.names, ["°"] * len(angles.names), angles.moments)):
        for k, (name, unit) in enumerate(zip(names, units, strict=True)):
            curves.setdefault(name, Curve(unit, moments.mean[:, k], moments.q05[:, k], moments.q95[:, k]))
    return curves


def base(name: str) -> str:
    """Return the name without its side."""
    side = side_of(name)
    return name if not side else name.removeprefix(f"{side}_") if name.startswith(f"{side}_") else name.removesuffix(f"_{side}")


def _sides(name: str, run_curves: Mapping[str, Curve]) -> list[str]:
    """Return the names of the curves that a user's name stands for.

    Raises:
        InputError: there is none.
    """
    matches = [name] if name in run_curves else [candidate for candidate in run_curves if name == base(candidate)]
    if not matches:
        raise input_error("--curves", f"no curve '{name}'", f"names among {', '.join(run_curves)}", nearest(name, run_curves))
    return matches


def _draw(axes: "Axes", run: "SavedRun", curves: Mapping[str, Curve]) -> None:
    bands, seconds = not run.mode_seeker, np.arange(run.frames) / run.fps
    first, unit = next(iter(curves)), next(iter(curves.values())).unit
    title, label = _words(base(first) if len(curves) > 1 else first, unit)
    axes.set(title=title, xlabel="time, s", ylabel=label)
    shade_lost(axes, lost_frames(run), 1 / run.fps)
    for name, curve in curves.items():
        named = SIDES[side_of(name)] if len(curves) > 1 else None
        draw_band(axes, seconds, curve.mean, (curve.low, curve.high) if bands else None, paper(name), named)
    if run.frames > 1:
        axes.set_xlim(seconds[0], seconds[-1])
    drawn = [values for curve in curves.values() for values in ((curve.mean, curve.low, curve.high) if bands else (curve.mean,))]
    axes.set_ylim(*limits(np.concatenate(drawn), LEAST_SPAN[unit]))
    label_lines(axes)


def _words(name: str, unit: str) -> tuple[str, str]:
    """Return a panel's title, and the label of its axis with the movement to which positive values of a clinical angle belong."""
    title = spoken(name).replace("_", " ")
    side = side_of(name)
    if side and name.endswith(f"_{side}"):
        title = f"{SIDES[side]} {base(name).replace('_', ' ')}"
    positive = next((angle.positive for joint in CLINICAL for angle in joint.angles if angle.name == base(name)), "")
    label = "position, m" if unit == "m" else f"degrees, + {positive}" if positive else "angle, degrees"
    return title[:1].upper() + title[1:], label
