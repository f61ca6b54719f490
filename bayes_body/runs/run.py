"""A whole run on disk: track a session, and leave behind all that is needed to inspect, to repeat and to continue it.

`run.toml` comes first, then each frame as it is computed, the posterior before the figures and these before the pictures. Whatever stops a run, what
it has computed stays, and a later one goes on from there to the same end.
"""

import json
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import jax

from bayes_body.errors import input_error
from bayes_body.files.atomic import make_folder, remove_partial, write_text
from bayes_body.files.lock import check_unlocked, locked
from bayes_body.initial import apply_first_pose, first_pose, is_fitted, restored, stored
from bayes_body.metrics import summarise, true_markers
from bayes_body.model.build import Model, load_model
from bayes_body.model.definition import Definition, load_definition
from bayes_body.posterior import stream_posterior
from bayes_body.posterior.diagnostics import diagnose, sentences, worst_figures
from bayes_body.posterior.stream import stored_frames
from bayes_body.registry import find, notes
from bayes_body.session.read import load_session
from bayes_body.session.session import Session
from bayes_body.storage import FrameFiles
from bayes_body.storage.run_file import NAME as RUN_FILE
from bayes_body.storage.run_file import describe, read_run_file, refuse_changes, write_run_file
from bayes_body.storage.saved_run import load_run
from bayes_body.toml.read import validate
from bayes_body.tracking.draws import Draws
from bayes_body.tracking.program import compiled_ahead
from bayes_body.tracking.track import track
from bayes_body.view.figures_text import figures_text
from bayes_body.view.overlay import draw_overlay, is_drawn
from bayes_body.view.progress import progress_bar, waiting, watched

POSTERIOR, SUMMARY, FRAMES = "posterior.nc", "summary.json", "frames"
# What a new run takes where nothing is said.
# Options of kernels with a flag of their own on the command line; the others are given by --set.
FLAGS = ("particles", "layers", "move", "moves", "leapfrog_steps")
DEFAULTS = {"model": "deutscher_apf", "runs": 1, "seed": 0}

type Show = Callable[[str], None]
type Record = dict[str, dict[str, Any]]


@dataclass(frozen=True)
class Settings:
    """What a run is made of. What is None is as the folder's run has it where that is continued, or else as the model has it or DEFAULTS say.

    Attributes:
        session: folder of the session.
        out: folder of the run.
        model: a definition's name or path.
        kernel: a kernel's name.
        overrides: options of the kernel that differ from the definition's.
        runs: independent filters.
        frames: how many frames; all where nothing is said.
        seed: of everything random.
        resume: whether to go on with the run of the folder.
    """

    session: Path
    out: Path
    model: str | None = None
    kernel: str | None = None
    overrides: Mapping[str, Any] = field(default_factory=dict)
    runs: int | None = None
    frames: int | None = None
    seed: int | None = None
    resume: bool = False


def run(settings: Settings, show: Show, bar: bool) -> dict[str, Any]:
    """Track and write everything; returns what `summary.json` holds.

    Args:
        settings: the run.
        show: takes lines for the user.
        bar: whether a progress bar is drawn on standard error.

    Raises:
        InputError: an input cannot be used, the folder holds another run or another process works on it, or something cannot be written.
    """
    check_unlocked(settings.out)
    kept = _kept_record(settings)
    chosen = choose(settings, kept)
    session, definition = load_session(settings.session), load_definition(chosen.model)
    kind, options = kernel_options(definition, chosen.kernel, settings.overrides, (kept or {}).get("kernel"))
    term, model = find("kernel", kind), load_model(definition, session)
    # A truth that cannot be used is told before the tracking, not after it.
    true_markers(session)
    record = describe(settings.session, chosen.model, definition, kind, options.model_dump(), chosen.runs, chosen.seed, chosen.frames)
    if kept:
        refuse_changes(settings.out, kept, record)
    kernel = term.build(options=options)
    with compiled_ahead(session, model, kernel, options.particles) if _fits(session, kept) else nullcontext() as ahead:
        model, record = _with_first_pose(model, session, record, kept, settings.out, show)
    with locked(make_folder(settings.out)):
        frames = _begin(settings.out, chosen.frames or session.frames, show)
        write_run_file(settings.out, record)
        for note in notes([("kernel", kind), *(("likelihood", each.kind) for each in definition.likelihoods)]):
            show(note)
        with _kept(frames, settings.out, show):
            with progress_bar(bar, len(frames)) as on_frame:
                key, many = jax.random.key(chosen.seed), options.particles
                draws = track(session, model, kernel, key, many, chosen.runs, chosen.frames, on_frame, frames, ahead)
            return _leave(session, draws, settings.out, {"kernel": kind, "seed": chosen.seed}, show, bar)


def _fits(session: Session, kept: Mapping[str, Mapping[str, Any]] | None) -> bool:
    """Whether the first pose must be fitted; a run that is continued has kept it."""
    return is_fitted(session) and "first_pose" not in (kept or {})


def _with_first_pose(
    model: Model, session: Session, record: Record, kept: Mapping[str, Mapping[str, Any]] | None, out: Path, show: Show
) -> tuple[Model, Record]:
    """The model with its first pose where that must be found, and the record with it; a run that is continued starts from the pose that it kept."""
    if _fits(session, kept):
        found = first_pose(model, session)
        for remark in found.remarks:
            show(f"first pose: {remark}")
    elif kept and "first_pose" in kept:
        found = restored(model, kept["first_pose"], f"{out / RUN_FILE}: first_pose")
    else:
        return model, record
    return apply_first_pose(model, session, found), {**record, "first_pose": stored(model, found)}


class Chosen(NamedTuple):
    """Settings with every default in its place; `kernel` None is the model's own, `frames` None is all."""

    model: str
    kernel: str | None
    runs: int
    frames: int | None
    seed: int


def choose(settings: Settings, kept: Mapping[str, Mapping[str, Any]] | None) -> Chosen:
    """What is given, or else what the run that is continued has, or else what a new one takes."""
    defaults = DEFAULTS if kept is None else {**DEFAULTS, **kept["run"], "kernel": kept["kernel"].get("kind")}
    values: dict[str, Any] = {name: getattr(settings, name) for name in Chosen._fields}
    chosen: dict[str, Any] = {name: defaults.get(name) if value is None else value for name, value in values.items()}
    return Chosen(**chosen)


def kernel_options(definition: Definition, kind: str | None, overrides: Mapping[str, Any], kept: Mapping[str, Any] | None = None) -> tuple[str, Any]:
    """The kernel's name and options: the definition's where it is the definition's kernel, else that kernel's own defaults; `overrides` go first.

    Args:
        definition: of the model.
        kind: the kernel's name; None takes the definition's.
        overrides: options that are given for this run.
        kept: kernel and options of the run that is continued; they take the place of the definition's.

    Raises:
        InputError: there is no such kernel, or an option that it does not have or may not have.
    """
    kind = kind or definition.kernel.kind
    schema = find("kernel", kind).options
    given = definition.kernel.options.model_dump() if kind == definition.kernel.kind else {}
    if kept and kept.get("kind") == kind:
        given = {name: value for name, value in kept.items() if name != "kind"}
    for name in overrides:
        if name not in schema.model_fields:
            found, expected = f"the kernel '{kind}' has no such option", f"one of {', '.join(schema.model_fields)}"
            raise input_error(_flag(name, overrides[name]), found, expected, "leave it out")
    return kind, validate(schema, given | dict(overrides), "the kernel's options")


def _flag(name: str, value: Any) -> str:
    """How a user gave an option of the kernel on the command line."""
    return f"--{name.replace('_', '-')}" if name in FLAGS else f"--set {name}={json.dumps(value)}"


def _kept_record(settings: Settings) -> dict[str, dict[str, Any]] | None:
    """The settings of the run that is to be continued; None where a new one begins."""
    out, frames = settings.out, len(FrameFiles(settings.out / FRAMES))
    if settings.resume:
        # A folder without frames is a run that stopped before the first of them, or none yet: the same command begins it.
        return read_run_file(out) if frames or (out / RUN_FILE).exists() else None
    for name in (POSTERIOR, SUMMARY):
        if (out / name).exists():
            remedy = "name another with --out, continue it with --resume, or remove it"
            raise input_error(out, f"holds another run ({name})", "a folder without one", remedy)
    if frames:
        found, remedy = f"holds a run that stopped at frame {frames}", "continue it with --resume, or name another folder with --out"
        raise input_error(out, found, "a folder without one", remedy)
    return None


def _begin(out: Path, asked: int, show: Show) -> FrameFiles:
    """The frames that are there already, whole ones only."""
    frames = FrameFiles(out / FRAMES)
    remove_partial(out)
    damage = frames.mend()
    if damage:
        show(f"{damage} It is computed again.")
    if len(frames) > asked:
        raise input_error("--frames", str(asked), f"at least the {len(frames)} frames that the run has", "give a larger number")
    if len(frames):
        what = f"going on at frame {len(frames)} of {asked}" if len(frames) < asked else f"all {asked} frames are there, nothing is left to track"
        show(f"{out}: {what}")
    return frames


@contextmanager
def _kept(frames: FrameFiles, out: Path, show: Show) -> Iterator[None]:
    """Say, whatever stops the run, that it can be continued."""
    try:
        yield
    except BaseException:
        if len(frames):
            show(f"{out}: {len(frames)} frames are kept; the same command with --resume goes on from there.")
        raise


def _leave(session: Session, draws: Draws, out: Path, figures: Mapping[str, Any], show: Show, bar: bool) -> dict[str, Any]:
    """Posterior, summary and pictures, as far as they are not there for all frames; `figures` go into the summary as they are."""
    if stored_frames(out / POSTERIOR) != len(draws.frames):
        stream_posterior(draws, out / POSTERIOR, figures)
    diagnosis, told = _diagnosed(out, bar)
    summary = _stored_summary(out / SUMMARY)
    if summary.get("frames") != len(draws.frames):
        summary = summarise(session, draws, **figures, watch=watched("figures", bar)) | diagnosis
        write_text(out / SUMMARY, json.dumps(summary, indent=2) + "\n")
    if not is_drawn(out, len(draws.frames)):
        draw_overlay(session, draws, out, watched("pictures", bar))
    show(figures_text(summary))
    for sentence in told:
        show(f"look at    {sentence}")
    return summary


def _diagnosed(out: Path, bar: bool) -> tuple[dict[str, Any], list[str]]:
    """The posterior's diagnostics: their worst figures, and what a reader must be told."""
    with load_run(out) as saved, waiting("diagnostics", bar):
        diagnosis = diagnose(saved)
    # Of a mode seeker the first sentence says that it is one: that is said before the run.
    return worst_figures(diagnosis), sentences(diagnosis)[diagnosis.mode_seeker :]


def _stored_summary(path: Path) -> dict[str, Any]:
    try:
        summary = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        # Missing, or not what a run writes: it is made anew.
        return {}
    return summary if isinstance(summary, dict) else {}
