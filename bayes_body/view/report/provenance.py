"""The section on how a run was made: the command that repeats it, versions, machine, the recording, and the definition's text."""

import shlex
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from bayes_body.base.errors import InputError
from bayes_body.base.toml.read import read_toml
from bayes_body.recording.session.session import Session
from bayes_body.view.report.markup import Markup, details, section, table, tag

if TYPE_CHECKING:
    from bayes_body.results.storage.saved_run import SavedRun

# Texts with more characters than this are cut, because the page has a size limit.
LONGEST = 200_000
AGAIN, AGAIN_SMOOTH = "This command repeats the run.", "This command smooths the same run of the filter again."
IDENTICAL = "With the same versions on the same kind of processor, the result is identical to the last bit."
SMOOTHER_OPTIONS = ("draws", "moves", "seed")
KERNEL_OPTIONS = ("particles", "layers", "move", "moves", "leapfrog_steps")


def command(run: "SavedRun") -> str:
    """Return `bayes-body track ...`, or `bayes-body smooth ...`, with the settings that are command-line options; the definition has the others."""
    again = f"{run.folder.resolve()}_again"
    if run.smoothed:
        words = ["bayes-body", "smooth", str(run.smoothing["folder"]), "--out", again]
        return _with_options(words, {name: run.smoothing[name] for name in SMOOTHER_OPTIONS})
    settings = run.settings
    options = {"model": settings["model"], "kernel": run.kernel["kind"]}
    options |= {name: run.kernel[name] for name in KERNEL_OPTIONS if name in run.kernel}
    options |= {name: settings[name] for name in ("runs", "first_frame", "frames", "seed") if name in settings}
    options |= {"keep": f"draws={settings['keep']}"} if settings.get("keep") else {}
    return _with_options(["bayes-body", "track", str(settings["session"]), "--out", again], options)


def _with_options(words: list[str], options: Mapping[str, Any]) -> str:
    for name, value in options.items():
        words += [f"--{name.replace('_', '-')}", str(value)]
    return shlex.join(words)


def provenance_section(run: "SavedRun") -> Markup:
    """Return the section. It needs neither the session's folder nor its images."""
    parts: list[str] = [
        tag("p", f"{AGAIN_SMOOTH if run.smoothed else AGAIN} {IDENTICAL}"),
        tag("pre", tag("code", command(run))),
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
