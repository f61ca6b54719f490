"""The head of the page: a verdict in a line, the figures with their units, and what to look at."""

import re
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from bayes_body.posterior.blocks import log_mean_exp
from bayes_body.view.report.markup import Markup, joined, section, table, tag

if TYPE_CHECKING:
    from bayes_body.posterior.diagnostics import Diagnosis

# Key of summary.json, what it is, how it is written.
WHAT = (
    ("frames", "frames", "{:,}"),
    ("frames_lost", "of them lost", "{:,}"),
    ("cameras", "cameras", "{}"),
    ("dof", "degrees of freedom", "{}"),
    ("runs", "independent runs", "{}"),
    ("particles", "particles a run", "{:,}"),
    ("layers", "layers a frame", "{}"),
)
# What only a session with a truth has.
TRUTH = (
    ("error_mm_mean", "distance from the true markers", "{:.0f} mm"),
    ("coverage_90", "share of the truth inside the 90 % intervals", "{:.2f}"),
)
QUALITY = (
    ("iou_median", "overlap with the silhouettes (IoU), median", "{:.3f}"),
    ("marker_disagreement_mm", "distance between the runs' mean markers", "{:.1f} mm"),
    ("seconds_per_frame", "time a frame, all runs", "{:.3g} s"),
    ("seconds_compile", "compilation", "{:.1f} s"),
    ("evaluations_per_second", "evaluations of the likelihood", "{:,.0f} a second"),
    ("peak_memory_mb", "largest memory", "{:,.0f} MB"),
)


def verdict(told: Sequence[str], agreement_known: bool) -> Markup:
    """The run in a line: whether any limit is crossed, or the gravest sentence."""
    if not told:
        return joined(["The runs agree; no limit is crossed." if agreement_known else "No limit is crossed."])
    more = len(told) - 1
    return sentence(told[0]) if not more else joined([sentence(told[0]), f"And {more} more to look at."])


def sentence(text: str) -> Markup:
    """With a capital first, and options of the command line as such."""
    parts = re.split(r"(--[a-z-]+)", text[:1].upper() + text[1:])
    return Markup("".join(tag("code", part) if part.startswith("--") else joined([part]) for part in parts))


def key_figures(summary: Mapping[str, Any], diagnosis: "Diagnosis") -> Markup:
    """The figures that a reader asks for first; what does not exist is a dash, but for what only a truth tells."""
    known = [row for row in TRUTH if summary.get(row[0]) is not None]
    what, truth, quality = ([(label, written(summary[key], form)) for key, label, form in rows if key in summary] for rows in (WHAT, known, QUALITY))
    ess = f"{np.median(diagnosis.ess):.0f} (median), {diagnosis.ess.min():.0f} (least) of {diagnosis.particles:,}"
    rhat = written(_largest(diagnosis.rhat), "{:.2f}")
    mine = [("effective particles", ess), ("R-hat over the runs, at most", rhat), ("log-evidence", _evidence(diagnosis))]
    return tag("div", table((), what), table((), [*truth, *mine, *quality]), class_="pair")


def _largest(values: np.ndarray) -> float:
    finite = values[np.isfinite(values)]
    return float(finite.max()) if finite.size else float("nan")


def _evidence(diagnosis: "Diagnosis") -> str:
    by_run = diagnosis.evidence_by_run
    if not np.isfinite(by_run).all():
        return "–"
    mean = log_mean_exp(by_run)
    spread = "spread unknown (a single run)" if np.isnan(diagnosis.evidence_sd) else f"± {diagnosis.evidence_sd:.1f} nats (sd over the runs)"
    return f"{mean:,.1f} nats, {spread}" if np.isnan(diagnosis.evidence_sd) else f"{mean:,.1f} {spread}"


def written(value: Any, form: str) -> str:
    """The value in that form, or a dash where there is none."""
    missing = value is None or (isinstance(value, float) and not np.isfinite(value))
    return "–" if missing else form.format(value) if isinstance(value, int | float) else str(value)


def findings(told: Sequence[str]) -> Markup:
    """What to look at, each with its remedy."""
    if not told:
        return section("findings", "What to look at", tag("p", "No limit is crossed."))
    return section("findings", "What to look at", tag("ol", *(tag("li", sentence(each)) for each in told)))
