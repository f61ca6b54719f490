"""The head of the page: the result in one line, and the key figures with their units; and the sections on warnings and on how the run was made.

The section on how a run was made has the command that repeats it, versions, machine, the recording, and the definition's text.
"""

import re
import shlex
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from bayes_body.base.errors import InputError
from bayes_body.base.toml.read import read_toml
from bayes_body.recording.session.session import Session
from bayes_body.results.metrics.summary import shows_overlap, shows_reprojection
from bayes_body.results.posterior.blocks import log_mean_exp
from bayes_body.view.report.markup import Markup, details, joined, section, table, tag

if TYPE_CHECKING:
    from bayes_body.results.posterior.diagnostics import Diagnosis
    from bayes_body.results.storage.saved_run import SavedRun
    from bayes_body.view.report.inspection import Inspection

# Key of summary.json, label, format.
WHAT = (
    ("frames", "frames", "{:,}"),
    ("frames_lost", "lost frames", "{:,}"),
    ("cameras", "cameras", "{}"),
    ("dof", "degrees of freedom", "{}"),
    ("runs", "independent runs", "{}"),
    ("particles", "particles per run", "{:,}"),
    ("layers", "layers per frame", "{}"),
)
# Only for a session with a truth.
TRUTH = (
    ("error_mm_mean", "distance from the true markers", "{:.0f} mm"),
    ("coverage_90", "fraction of the truth inside the 90 % intervals", "{:.2f}"),
)
# Figures of what the run was fitted to: key, words of the verdict, label in the table, its format.
KEYPOINTS = (
    "reprojection_px_median",
    "median reprojection error of the keypoints {:.1f} px",
    "reprojection error of the keypoints, median",
    "{:.1f} px",
)
OVERLAP = ("iou_median", "overlap with the silhouettes {:.2f}", "overlap with the silhouettes (IoU), median", "{:.3f}")
QUALITY = (
    ("marker_disagreement_mm", "distance between the runs' mean markers", "{:.1f} mm"),
    ("redone_starts_share", "frames done again from more starting points", "{:.1%}"),
    ("redone_tempered_share", "frames done again by tempered", "{:.1%}"),
    ("normal_doubtful_share", "frames that no normal distribution fits well (Pareto k above 0.7)", "{:.1%}"),
    ("joint_steps_max", "Newton steps to the Gaussian of all frames, at most", "{:.0f}"),
    ("joint_pareto_k_share", "windows that the Gaussian fits (Pareto k at most 0.7)", "{:.0%}"),
    ("joint_near_limit_max", "frames in which a dof is near its limit, at most", "{:.0%}"),
    ("seconds_per_frame", "time per frame, all runs", "{:.3g} s"),
    ("seconds_compile", "compilation", "{:.1f} s"),
    ("evaluations_per_second", "evaluations of the likelihood", "{:,.0f} per second"),
    ("peak_memory_mb", "peak memory", "{:,.0f} MB"),
)


def subtitle(run: "SavedRun") -> str:
    """Return the model, the kernel, for a smoothed run how it was smoothed, and the definition's title."""
    how = f"kernel {run.kernel['kind']}"
    if run.smoothed:
        law = " from one Gaussian of all frames" if run.smoothing.get("start") == "joint" else ""
        how = f"{how}, smoothed: {run.smoothing['draws']:,} paths of each run{law}, given all images"
    return f"Model {run.settings['model']}, {how}; {run.texts.get('title', 'no title')}."


def scales(inspection: "Inspection") -> str:
    """Return what holds for the whole page: how wide its intervals are, and where its time begins."""
    wide = "" if inspection.diagnosis.mode_seeker else "Every interval and band of this page holds 90 % of the posterior (5 to 95 %). "
    return f"{wide}Time is in seconds from frame {inspection.number(0)}; there are {inspection.fps:g} frames per second." if inspection.fps else wide


def verdict(summary: Mapping[str, Any], warnings: Sequence[str], agreement_known: bool) -> Markup:
    """Return the result in one line, then whether a limit is crossed: the most serious warning and the number of the others."""
    result = _result(summary)
    if not warnings:
        return joined([*result, "The runs agree; no limit is crossed." if agreement_known else "No limit is crossed."])
    more = len(warnings) - 1
    remaining_warnings = [f"{more} more {'warning' if more == 1 else 'warnings'} below."] if more else []
    return joined([*result, Markup(f"Warning: {sentence(warnings[0], capital=False)}"), *remaining_warnings])


def _result(summary: Mapping[str, Any]) -> list[str]:
    """Return a sentence with the frames and the overlap, and with a truth the error and the coverage; nothing if the run has no summary."""
    if summary.get("frames") is None:
        return []
    figures = (*((key, form) for key, form, _, _ in _fitted(summary)), ("error_mm_mean", "mean markers {:.0f} mm from the truth"))
    phrases = [form.format(summary[key]) for key, form in figures if summary.get(key) is not None]
    if summary.get("coverage_90") is not None:
        phrases.append(f"{100 * summary['coverage_90']:.0f}\u00a0% of the truth inside the 90\u00a0% intervals")
    restarts = summary.get("frames_restarted") or []
    frames = f"{summary['frames']:,} frame{'s' * (summary['frames'] != 1)} tracked, {summary.get('frames_lost') or 'none'} lost"
    frames += f", restarted at frame{'s' * (len(restarts) > 1)} {', '.join(map(str, restarts))}" if restarts else ""
    return ["; ".join([frames, *phrases]) + "."]


def _fitted(summary: Mapping[str, Any]) -> list[tuple[str, str, str, str]]:
    """Return the figures of what the run was fitted to: no overlap for a run that reads no silhouettes."""
    return [*([KEYPOINTS] if shows_reprojection(summary) else []), *([OVERLAP] if shows_overlap(summary) else [])]


def sentence(text: str, capital: bool = True) -> Markup:
    """Return the sentence with a capital first letter, and with command-line options as code."""
    parts = re.split(r"(--[a-z-]+)", (text[:1].upper() if capital else text[:1]) + text[1:])
    return Markup("".join(tag("code", part) if part.startswith("--") else joined([part]) for part in parts))


def key_figures(summary: Mapping[str, Any], diagnosis: "Diagnosis", smoothed: bool = False) -> Markup:
    """Return the main figures. A figure that does not exist is a dash; figures that need a truth are left out without one.

    Args:
        summary: the content of summary.json.
        diagnosis: the run's diagnostic figures.
        smoothed: whether the draws are paths. Their effective number is that of the different states of a frame.
    """
    truth_rows = [row for row in TRUTH if summary.get(row[0]) is not None]
    fitted = [(key, label, form) for key, _, label, form in _fitted(summary)]
    run_rows, truth, quality = (
        [(label, written(summary[key], form)) for key, label, form in rows if key in summary] for rows in (WHAT, truth_rows, (*fitted, *QUALITY))
    )
    ess = f"{np.median(diagnosis.ess):.0f} (median), {diagnosis.ess.min():.0f} (minimum) of {diagnosis.particles:,}"
    rhat = written(_largest(diagnosis.rhat), "{:.2f}")
    effective = "different states of a frame" if smoothed else "effective particles"
    mine = [(effective, ess), ("R-hat over the runs, at most", rhat), ("log-evidence", _evidence(diagnosis))]
    if smoothed:
        run_rows = [
            ("paths of each run" if label == "particles per run" else label, value) for label, value in run_rows if label != "layers per frame"
        ]
    return tag("div", table((), run_rows), table((), [*truth, *mine, *quality]), class_="pair")


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
    """Return the value in that format, or a dash if there is none."""
    missing = value is None or (isinstance(value, float) and not np.isfinite(value))
    return "–" if missing else form.format(value) if isinstance(value, int | float) else str(value)


def findings(warnings: Sequence[str]) -> Markup:
    """Return the section of warnings, each with its remedy."""
    if not warnings:
        return section("warnings", "Warnings", tag("p", "No limit is crossed."))
    return section("warnings", "Warnings", tag("ol", *(tag("li", sentence(warning)) for warning in warnings)))


# Texts with more characters than this are cut, because the page has a size limit.
LONGEST = 200_000
AGAIN, AGAIN_SMOOTH = "This command repeats the run.", "This command smooths the same run of the filter again."
IDENTICAL = "With the same versions on the same kind of processor, the result is identical to the last bit."
COMBINE_AGAIN = "This command puts the same runs together again."
SMOOTHER_OPTIONS = ("draws", "start", "moves", "seed")
KERNEL_OPTIONS = ("particles", "layers", "move", "moves", "leapfrog_steps")


def command(run: "SavedRun") -> str:
    """Return `bayes-body track ...`, or `bayes-body smooth ...`, with the settings that are command-line options; the definition has the others."""
    new_folder = f"{run.folder.resolve()}_again"
    if run.chains:
        draws = f"draws={run.kept}" if run.kept else "all"
        return shlex.join(["bayes-body", "combine", *run.chains["folders"], "--out", new_folder, "--keep", draws])
    if run.smoothed:
        words = ["bayes-body", "smooth", str(run.smoothing["folder"]), "--out", new_folder]
        return _with_options(words, {name: run.smoothing[name] for name in SMOOTHER_OPTIONS if name in run.smoothing})
    settings = run.settings
    options = {"model": settings["model"], "kernel": run.kernel["kind"]}
    options |= {name: run.kernel[name] for name in KERNEL_OPTIONS if name in run.kernel}
    options |= {name: settings[name] for name in ("runs", "first_frame", "frames", "seed") if name in settings}
    options |= {"keep": f"draws={settings['keep']}"} if settings.get("keep") else {}
    return _with_options(["bayes-body", "track", str(settings["session"]), "--out", new_folder], options)


def _with_options(words: list[str], options: Mapping[str, Any]) -> str:
    for name, value in options.items():
        words += [f"--{name.replace('_', '-')}", str(value)]
    return shlex.join(words)


def provenance_section(run: "SavedRun") -> Markup:
    """Return the section. It needs neither the session's folder nor its images."""
    parts: list[str] = [
        tag("p", f"{COMBINE_AGAIN if run.chains else AGAIN_SMOOTH if run.smoothed else AGAIN} {IDENTICAL}"),
        tag("pre", tag("code", command(run))),
        *([tag("h3", "Runs"), table((), _chains(run))] if run.chains else []),
        *([tag("h3", "Smoother"), table((), _rows(run.smoothing))] if run.smoothed else []),
        tag("h3", "Kernel of the filter" if run.smoothed else "Kernel"),
        table((), [(key, str(value)) for key, value in run.kernel.items()]),
        tag("h3", "Recording"),
        _recording(run),
        tag("h3", "Versions and machine"),
        table((), [*_rows(run.versions), *_rows(_machine(run))]),
    ]
    names = {"text": f"Definition: {run.settings['model']}", "body_text": "Body", "session": "Session, as the run saw it"}
    parts += [details(title, tag("pre", tag("code", _cut(run.texts[key])))) for key, title in names.items() if run.texts.get(key)]
    return section("made", "How it was made", *parts)


def _chains(run: "SavedRun") -> list[tuple[str, str]]:
    """Return the folder and the seed of each run that is a chain of this one."""
    return [(folder, f"seed {seed}") for folder, seed in zip(run.chains["folders"], run.chains["seeds"], strict=False)]


def _rows(values: Mapping[str, Any]) -> list[tuple[str, str]]:
    return [(str(key), ", ".join(map(str, value)) if isinstance(value, list) else str(value)) for key, value in values.items()]


def _machine(run: "SavedRun") -> Mapping[str, Any]:
    machine = read_toml(run.folder / "run.toml").get("machine")
    return machine if isinstance(machine, dict) else {}


def _recording(run: "SavedRun") -> Markup:
    """Return a table with the session's title, folder, cameras, frames and subject."""
    try:
        session = run.session
    except InputError as error:
        return tag("p", f"The session can no longer be read: {error}")
    cameras = "; ".join(f"{view.camera.name} {view.camera.size_px[0]} × {view.camera.size_px[1]} px" for view in session.views)
    rows = [
        ("title", session.title),
        ("folder", str(session.folder)),
        ("cameras", cameras),
        ("frames", f"{session.frames}{_numbers(session)}, at {session.fps:g} per second"),
    ]
    return table((), [*rows, ("subject", _subject(session.subject.height_m, len(session.subject.lengths_m)))])


def _numbers(session: Session) -> str:
    """The numbers of the frames, unless they count from 0."""
    return f" ({session.first_frame} to {session.frame_number(session.frames - 1)})" if session.first_frame else ""


def _subject(height: float | None, lengths: int) -> str:
    tall = "height unknown" if height is None else f"{height:g} m tall"
    return f"{tall}; {lengths} segment lengths measured"


def _cut(text: str) -> str:
    return text if len(text) <= LONGEST else f"{text[:LONGEST]}\n[cut after {LONGEST:,} characters of {len(text):,}]"
