"""The gait of a smoothed run as tables: the walk, and its events."""

from collections.abc import Sequence

from bayes_body.base.errors import InputError
from bayes_body.results.clinical.gait import POINTS, gait_of
from bayes_body.results.clinical.gait_table import Row, event_rows, walk_rows
from bayes_body.results.clinical.trajectories import marker_paths
from bayes_body.view.colours import NAMES
from bayes_body.view.colours import SIDES as SIDE_COLOURS
from bayes_body.view.report.inspection import Inspection
from bayes_body.view.report.markup import Markup, details, section, table, tag

# Rows of the table of events: a long recording has thousands.
MOST_EVENTS = 200
LEGEND = "Computed for each draw, which is a whole path of the smoothed run. The intervals include the error of the method."
DOT = "display: inline-block; width: .7em; height: .7em; margin-right: .4em; border-radius: 50%; background: "
SIDES = {side: Markup(f"{tag('i', style=DOT + SIDE_COLOURS[side])}{NAMES[side]}") for side in ("r", "l")} | {"": ""}


def has_gait(inspection: Inspection) -> bool:
    """Whether the run's draws are paths, and its body has the markers of a gait."""
    try:
        return inspection.run.smoothed and set(POINTS) <= set(inspection.run.model.body.markers.names)
    except InputError:
        return False


def gait_section(inspection: Inspection) -> Markup:
    """Return the section; a sentence if nobody walks."""
    try:
        gait = gait_of(marker_paths(inspection.run, POINTS), inspection.run.fps, "xyz".index(inspection.run.session.up))
    except InputError as error:
        return section("gait", "Gait", tag("p", f"{error}"))
    if not gait.events:
        return section("gait", "Gait", tag("p", "No steps were found."))
    parts = [tag("p", LEGEND)]
    if gait.strides:
        parts.append(_table("the walk", walk_rows(gait)))
    first = f"the first {MOST_EVENTS} of " if len(gait.events) > MOST_EVENTS else ""
    rows = event_rows(gait)[:MOST_EVENTS]
    parts.append(details(f"{first}{len(gait.events)} events, s from the first frame", _table("event", rows), shown=not gait.strides))
    if first:
        parts.append(tag("p", f"bayes-body gait writes all {len(gait.events)} events and {len(gait.strides)} strides.", class_="note"))
    return section("gait", "Gait", *parts)


def _table(first: str, rows: Sequence[Row]) -> Markup:
    head = (first, "side", "mean", "sd", "90 % interval", "unit", "share of the draws")
    return table(head, (_cells(row) for row in rows))


def _cells(row: Row) -> tuple[str, ...]:
    digits = 1 if row.unit in ("%", "steps/min") else 3
    mean, sd, low, high = (f"{value:.{digits}f}" for value in (row.mean, row.sd, row.q05, row.q95))
    return row.quantity.replace("_", " "), SIDES[row.side], mean, sd, f"{low} to {high}", row.unit, f"{row.share_of_draws:.0%}"
