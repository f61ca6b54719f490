"""The section on what was not known: each unknown's entries in the last frame, against their prior."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from bayes_body.results.metrics.unknown_sentences import UNDETERMINED, shift, shown
from bayes_body.view.colours import INK, SKIN
from bayes_body.view.report.figures import encoded, new_panel, set_margins
from bayes_body.view.report.head import written
from bayes_body.view.report.inspection import Inspection, spoken
from bayes_body.view.report.markup import Markup, Picture, details, figures, section, table, tag

TITLE = "What was not known"
ABOUT = (
    "The definition says that these quantities are not known exactly. The grey band is the prior, the dot and the bar are the posterior in the last "
    "frame, over all runs: the mean and 1.64 standard deviations on both sides. A short bar was determined by the recording. A bar as long as the "
    "band was not: there only the prior speaks. A dot outside of its band says that the session is wrong there."
)
SEEKER = "The kernel is a mode seeker: there are no bars, as the spread of its particles is not a measure of uncertainty."
# Standard deviations on both sides of a mean that hold 90 % of a normal distribution.
HALF_WIDTH = 1.645

type Row = Mapping[str, Any]


def unknown_section(inspection: Inspection) -> Markup:
    """Return the section: what stays undetermined, a picture for each unknown and unit, and all figures."""
    summary = inspection.run.summary
    rows: Sequence[Row] = summary.get("unknowns") or ()
    if not rows:
        return section("unknowns", TITLE, tag("p", "The model takes everything but the pose as known."))
    parts = [tag("p", ABOUT), *_findings(rows, summary)]
    parts.append(figures([_picture(*group) for group in _groups(rows).items()]))
    head = ("", "prior", "posterior", "sd, share of the prior's", "distance, prior sd", "R-hat")
    parts.append(details("All figures", table(head, [_cells(row) for row in rows])))
    return section("unknowns", TITLE, *parts)


def _findings(rows: Sequence[Row], summary: Mapping[str, Any]) -> list[Markup]:
    ratios = [row["sd_ratio"] for row in rows]
    if None in ratios:
        return [tag("p", SEEKER)]
    undetermined = sum(ratio > UNDETERMINED for ratio in ratios)
    sentence = f"{undetermined} of {len(rows)} entries stay as uncertain as their prior (more than {UNDETERMINED:.0%} of its standard deviation)."
    rhat, draws = summary.get("unknowns_rhat_max"), summary.get("unknowns_independent_draws_min")
    if rhat is None or draws is None:
        return [tag("p", sentence)]
    worth = f"R-hat over the runs is at most {rhat:.2f}, and a run is worth at least {draws:,.0f} independent draws."
    return [tag("p", f"{sentence} {worth}")]


def _groups(rows: Sequence[Row]) -> dict[tuple[str, str], list[Row]]:
    """Return the entries by unknown and unit, which share an axis."""
    groups: dict[tuple[str, str], list[Row]] = {}
    for row in rows:
        groups.setdefault((row["name"], row["unit"]), []).append(row)
    return groups


def _picture(group: tuple[str, str], rows: Sequence[Row]) -> Picture:
    """Return the plot of the entries of one unknown, one row each."""
    (name, _), (factor, unit), count = group, shown(rows[0]), len(rows)
    title = f"{spoken(name).capitalize()}, {unit}"
    figure, axes = new_panel(title, f"posterior and prior, {unit}", "", (4.2, 0.9 + 0.19 * count))
    set_margins(figure, 1.45, 0.14)
    # Bars would end at the edge of the panel.
    axes.use_sticky_edges = False
    places = np.arange(count)
    prior_mean, prior_sd, mean = (factor * np.array([row[key] for row in rows]) for key in ("prior_mean", "prior_sd", "mean"))
    axes.barh(places, 2 * HALF_WIDTH * prior_sd, 0.86, prior_mean - HALF_WIDTH * prior_sd, color=SKIN, linewidth=0)
    sd = [row["sd"] for row in rows]
    ends = None if None in sd else HALF_WIDTH * factor * np.array(sd)
    axes.errorbar(mean, places, xerr=ends, fmt="o", color=INK, markersize=3.2, linewidth=1.3)
    axes.set_yticks(places, [spoken(row["entry"]) for row in rows], fontsize=8.5)
    axes.set_ylim(count - 0.4, -0.6)
    axes.grid(visible=False, axis="y")
    furthest = max(rows, key=lambda row: abs(shift(row)))
    alt = f"{title}, in the last frame: furthest from its prior is {spoken(furthest['entry'])}, {shift(furthest):+.1f} prior sd."
    return encoded(figure, alt)


def _cells(row: Row) -> tuple[str, ...]:
    factor, unit = shown(row)
    prior = f"{factor * row['prior_mean']:.3g} ± {factor * row['prior_sd']:.3g} {unit}"
    spread = "" if row["sd"] is None else f" ± {factor * row['sd']:.2g}"
    name = f"{spoken(row['name'])}: {spoken(row['entry'])}"
    return (
        name,
        prior,
        f"{factor * row['mean']:.3g}{spread} {unit}",
        written(row["sd_ratio"], "{:.0%}"),
        f"{shift(row):+.1f}",
        written(row["rhat"], "{:.2f}"),
    )
