"""What was inferred, as lines of text: lengths, cameras, keypoint offsets and others, and how far cameras are from the keypoints."""

import math
from collections.abc import Iterator, Mapping, Sequence

from bayes_body.runs.unknowns.fitted_session import CAMERAS, MOTION
from bayes_body.runs.unknowns.posterior import LENGTHS, UNDETERMINED, Posterior

OFFSETS, DELAYS = "keypoint_offsets", "delays"
MARK = "*"
LEGEND = f"{MARK} not determined by the keypoints: more than {100 * UNDETERMINED:.0f} % of the prior's standard deviation is left."
# The unit that a person reads, and how many of it one of the model's are.
SHOWN = {"m": ("mm", 1000.0), "rad": ("deg", 180 / math.pi), "s": ("ms", 1000.0), "px": ("px", 1.0), "": ("%", 100.0)}


def fit_lines(posteriors: Mapping[str, Posterior], cameras: Sequence[str], before_px: Sequence[float], after_px: Sequence[float]) -> list[str]:
    """Return the tables of a fit.

    Args:
        posteriors: from `posteriors_of`.
        cameras: names of the cameras.
        before_px: median distance of the keypoints in each camera from where the body puts them, with the session as it was.
        after_px: the same with the new session.
    """
    lines = []
    for name, values in posteriors.items():
        rows = list(_rows(name, values, cameras))
        lines += ["", *aligned(rows)]
    if any((values.remaining > UNDETERMINED).any() for values in posteriors.values()):
        lines += ["", LEGEND]
    distances = zip(cameras, before_px, after_px, strict=True)
    rows = [("keypoints to body", "before", "after"), *((camera, f"{old_px:.1f} px", f"{new_px:.1f} px") for camera, old_px, new_px in distances)]
    return [*lines, "", *aligned(rows)]


def aligned(rows: Sequence[Sequence[str]]) -> list[str]:
    """Return the rows of a table as lines: the first column begins at the left, the others end at the right."""
    widths = [max(len(cell) for cell in column) for column in zip(*rows, strict=True)]

    def line(cells: Sequence[str]) -> str:
        numbers = (cell.rjust(width) for cell, width in zip(cells[1:], widths[1:], strict=True))
        return "  ".join([cells[0].ljust(widths[0]), *numbers]).rstrip()

    return [line(row) for row in rows]


def _rows(name: str, values: Posterior, cameras: Sequence[str]) -> Iterator[Sequence[str]]:
    if name == LENGTHS:
        yield from _lengths(values)
    elif name == CAMERAS:
        yield from _cameras(values, cameras)
    elif name == OFFSETS:
        yield from _offsets(values)
    else:
        yield name, "before", "after", ""
        for index, label in enumerate(values.labels):
            unit, scale = SHOWN[values.units[index]]
            yield label, f"{scale * values.prior_mean[index]:.1f} {unit}", _entry(values, index), unit


def _lengths(values: Posterior) -> Iterator[Sequence[str]]:
    yield LENGTHS, "before", "after", "sd", ""
    shown = set()
    for index, label in enumerate(values.labels):
        # Both sides have one length, unless the definition sets them free.
        stem = label[2:] if label.startswith(("l_", "r_")) else label
        figures = f"{values.prior_mean[index]:.3f} m", f"{values.mean[index]:.3f} m", f"{1000 * values.sd[index]:.0f} mm", _mark(values, index)
        has_sides = sum(sibling[2:] == stem for sibling in values.labels if sibling.startswith(("l_", "r_"))) == 2
        alike = (
            has_sides and len({round(float(mean), 6) for sibling, mean in zip(values.labels, values.mean, strict=True) if sibling[2:] == stem}) == 1
        )
        name = stem if alike else label
        if name not in shown:
            shown.add(name)
            yield name, *figures


def _cameras(values: Posterior, cameras: Sequence[str]) -> Iterator[Sequence[str]]:
    size = len(values.labels) // len(cameras)
    units = [SHOWN[unit][0] for unit in values.units[:size]]
    titles = [f"{label.removeprefix(f'{cameras[0]}_')} {unit}" for label, unit in zip(values.labels[:size], units, strict=True)]
    titles[:MOTION] = [f"turn {axis}, deg" for axis in "xyz"] + [f"move {axis}, mm" for axis in "xyz"]
    yield (CAMERAS, *titles)
    for place, camera in enumerate(cameras):
        yield (camera, *(_entry(values, index) for index in range(place * size, (place + 1) * size)))


def _offsets(values: Posterior) -> Iterator[Sequence[str]]:
    yield "keypoint offsets", *(f"{axis}, mm" for axis in "xyz")
    places = {label: index for index, label in enumerate(values.labels)}
    for marker in dict.fromkeys(label[:-2] for label in values.labels):
        labels = [f"{marker}_{axis}" for axis in "xyz"]
        yield marker, *(_entry(values, places[label]) if label in places else "" for label in labels)


def _entry(values: Posterior, index: int) -> str:
    """Return mean and standard deviation in the unit that a person reads, with a mark if the data did not determine them."""
    unit, scale = SHOWN[values.units[index]]
    decimals = 2 if unit == "deg" else 1 if unit in ("px", "%") else 0
    # Not -0, which rounding makes of a small negative number.
    mean, sd = round(scale * values.mean[index], decimals) + 0.0, scale * values.sd[index]
    return f"{mean:+.{decimals}f} ± {sd:.{decimals}f}{_mark(values, index) or ' '}"


def _mark(values: Posterior, index: int) -> str:
    return MARK if values.remaining[index] > UNDETERMINED else ""
