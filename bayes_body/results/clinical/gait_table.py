"""The gait of a walk as a table: mean, standard deviation and quantiles over the draws of each event, stride, peak angle and the whole walk."""

import csv
import math
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from bayes_body.base.files.atomic import replacing
from bayes_body.results.clinical.gait import FEET, Gait, cadence, known_mean, speed
from bayes_body.results.clinical.ranges import AngleRange

PERCENT = 100.0


class Row(NamedTuple):
    """A quantity.

    Attributes:
        quantity: its name; events are times from the first frame. An angle has `_max`, `_min` or `_range` after its name.
        side: `r` or `l`; empty for the whole walk, and for angles in the middle of the body. In a stride, it is the side of the stride.
        number: the number of the event or stride of that side, from 1; 0 for a mean over the walk, and for an angle over the whole recording.
        unit: its unit.
        mean, sd, q05, q95: over the draws that have it.
        share_of_draws: how many of the draws have it, from 0 to 1.
    """

    quantity: str
    side: str
    number: int
    unit: str
    mean: float
    sd: float
    q05: float
    q95: float
    share_of_draws: float


def walk_rows(gait: Gait) -> list[Row]:
    """Return the quantities of the whole walk; none if it has no stride."""
    strides = gait.strides
    if not strides:
        return []
    rows = [
        _row("cadence", "", 0, "steps/min", cadence(gait)),
        _row("speed", "", 0, "m/s", speed(gait)),
        _row("stride_length", "", 0, "m", known_mean([stride.length for stride in strides])),
        _row("stride_time", "", 0, "s", known_mean([stride.duration for stride in strides])),
    ]
    for side in FEET:
        stances = [stride.stance for stride in strides if stride.side == side]
        if stances:
            rows.append(_row("stance", side, 0, "%", PERCENT * known_mean(stances)))
    return [row for row in rows if row.share_of_draws > 0]


def event_rows(gait: Gait) -> list[Row]:
    """Return the events, in the order of time."""
    count: dict[tuple[str, str], int] = {}
    rows = []
    for event in gait.events:
        key = event.kind, event.side
        count[key] = count.get(key, 0) + 1
        rows.append(_row(event.kind.replace(" ", "_"), event.side, count[key], "s", event.times))
    return rows


def stride_rows(gait: Gait) -> list[Row]:
    """Return length, time and stance of each stride."""
    return [row for side in FEET for row in _strides_of(gait, side) if row.share_of_draws > 0]


def angle_rows(ranges: Sequence[AngleRange]) -> list[Row]:
    """Return the largest and the smallest value and the range of motion of angles."""
    rows = []
    for angle_range in ranges:
        side = angle_range.stride_side or angle_range.side
        for name, draws in (("max", angle_range.largest), ("min", angle_range.smallest), ("range", angle_range.extent)):
            rows.append(_row(f"{angle_range.name}_{name}", side, angle_range.stride, "deg", draws))
    return [row for row in rows if row.share_of_draws > 0]


def write_gait(gait: Gait, path: Path, ranges: Sequence[AngleRange] = ()) -> None:
    """Write all rows as CSV; six decimals.

    Args:
        gait: the gait.
        path: the file.
        ranges: ranges of angles, over the recording and in strides.

    Raises:
        InputError: the file system does not accept the file.
    """
    with replacing(path) as partial, partial.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(Row._fields)
        for row in (*walk_rows(gait), *event_rows(gait), *stride_rows(gait), *angle_rows(ranges)):
            writer.writerow([f"{value:.6f}" if isinstance(value, float) else value for value in row])


def _strides_of(gait: Gait, side: str) -> Iterator[Row]:
    for number, stride in enumerate((stride for stride in gait.strides if stride.side == side), 1):
        yield _row("stride_length", side, number, "m", stride.length)
        yield _row("stride_time", side, number, "s", stride.duration)
        yield _row("stance", side, number, "%", PERCENT * stride.stance)


def _row(quantity: str, side: str, number: int, unit: str, draws: Float[np.ndarray, " draw"]) -> Row:
    finite_draws = draws[np.isfinite(draws)]
    share = finite_draws.size / draws.size
    if not finite_draws.size:
        return Row(quantity, side, number, unit, math.nan, math.nan, math.nan, math.nan, share)
    low, high = np.quantile(finite_draws, (0.05, 0.95))
    return Row(quantity, side, number, unit, float(finite_draws.mean()), float(finite_draws.std()), float(low), float(high), share)
