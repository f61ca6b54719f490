"""Smooth a run on disk: paths through all its frames, as a run of its own that reports, exports and diagnostics read like any other.

The frames are computed and stored from the last to the first. If it stops, a later call continues it to the same result. The joint posterior of all
frames is computed at once, and only stored in this order.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax

from bayes_body.base.errors import input_error
from bayes_body.base.files.lock import locked
from bayes_body.initial import Show
from bayes_body.kernels.paths.smoother import JointOptions, Options, Smoother, paths_options
from bayes_body.results.posterior.diagnostics import frame_ranges
from bayes_body.results.storage import FrameFiles
from bayes_body.results.storage.names import FRAMES_FOLDER, RUN_FILE
from bayes_body.results.storage.results import Results
from bayes_body.results.storage.run_changes import refuse_changes
from bayes_body.results.storage.run_file import computing_here, read_run_file, write_run_file
from bayes_body.results.storage.saved_run import SavedRun, load_run
from bayes_body.runs.finish import finish, kept_frames, remark_on_stop
from bayes_body.runs.joint import check_joint, joint_paths
from bayes_body.runs.other_figures import near_body
from bayes_body.runs.progress import smoothing_bar
from bayes_body.runs.settings import COMBINE_AGAIN, Record, refuse_occupied
from bayes_body.runs.size import smoothing_lines
from bayes_body.tracking.draws import Draws, timing_of
from bayes_body.tracking.smooth import smooth

FILTER = "the run of a filter, made by `bayes-body track`"


@dataclass(frozen=True)
class SmoothSettings:
    """The settings of a smoothed run.

    Attributes:
        source: folder of the filter's run.
        out: folder of the smoothed run.
        options: options of the smoother by name; those of the continued run, or the defaults, where they are not given.
        seed: seed of everything random; None for that of the continued run, or 0.
        resume: whether to continue the run in `out`.
        pictures: whether to draw the video and the stills.
    """

    source: Path
    out: Path
    options: Mapping[str, int | str]
    seed: int | None = None
    resume: bool = False
    pictures: bool = True


def smooth_run(settings: SmoothSettings, show: Show, bar: bool) -> dict[str, Any]:
    """Smooth a run and write everything. Return the content of `summary.json`.

    Args:
        settings: what to smooth, and how.
        show: receives lines for the user.
        bar: whether to show the progress on standard error.

    Raises:
        InputError: the run cannot be smoothed, its recording has changed, the folder has another run, or a file cannot be written.
    """
    if settings.out.resolve() == settings.source.resolve():
        raise input_error("--out", str(settings.out), "another folder than the filter's", "leave it out, or name a new one")
    with load_run(settings.source) as source:
        # Before the lock, which makes the folder.
        _check_source(source)
        with locked(settings.out):
            return _smooth(source, settings, show, bar)


def _smooth(source: SavedRun, settings: SmoothSettings, show: Show, bar: bool) -> dict[str, Any]:
    before = _continued(settings)
    smoothing = (before or {}).get("smoothing", {})
    stored = {name: smoothing[name] for name in Options.model_fields if name in smoothing}
    options = paths_options(str(source.kernel["kind"]), settings.options, stored)
    joint = isinstance(options, JointOptions)
    seed = smoothing.get("seed", 0) if settings.seed is None else settings.seed
    model, session = source.model, source.session
    if (joint or options.moves or model.reads_before) and source.changed_inputs:
        problem = f"{', '.join(sorted(source.changed_inputs))}: changed or gone since the run was made"
        alternative = "" if model.reads_before else ", or give --moves 0 without --start joint, which reads no images"
        raise input_error(source.folder, problem, "the recording of the run", f"put it back{alternative}")
    filtered = FrameFiles(source.folder / FRAMES_FOLDER, source.id)
    if len(filtered) < source.frames:
        raise input_error(filtered.folder, f"{len(filtered)} frames", f"the {source.frames} frames of the run", _again(source))
    if joint:
        check_joint(session, model, source.frames, int(source.settings["runs"]), options.draws, source.summary.get("frames_restarted") or [])
    elif source.kept:
        show(_of_few(source, options))
    record = _record(source, filtered, options, seed)
    if before:
        refuse_changes(settings.out, before, record)
    frames = _begin(settings.out, before, record, show, bar)
    for line in smoothing_lines(settings.out, model, options.draws, int(source.settings["runs"]), source.frames, len(frames)):
        show(line)
    for note in _notes(source, joint):
        show(note)
    seeing = near_body(session, model, filtered)
    with remark_on_stop(frames, settings.out, show):
        if isinstance(options, JointOptions):
            paths = joint_paths(session, seeing, options, filtered, jax.random.key(seed), frames, bar)
        else:
            with smoothing_bar(bar and len(frames) < len(filtered), len(frames)) as on_frame:
                paths = smooth(session, seeing, Smoother(options), filtered, jax.random.key(seed), frames, on_frame)
        draws = Draws(model, paths, timing_of(paths), tuple(view.camera.name for view in session.views), session.first_frame, declared_sample=True)
        figures = {"kernel": str(source.kernel["kind"]), "seed": seed}
        return finish(session, draws, Results(settings.out, frames), figures, [], show, bar, smoothed=True, pictures=settings.pictures)


def _check_source(run: SavedRun) -> None:
    """Check that a run has a posterior of a filter.

    Raises:
        InputError: it is smoothed already, or its particles are no posterior.
    """
    if run.smoothed:
        raise input_error(run.folder, "smoothed paths", FILTER, f"smooth {run.smoothing['folder']}, from which it was made, again")
    if run.mode_seeker:
        problem = f"the kernel '{run.kernel['kind']}' seeks modes: its particles are not a sample of the posterior"
        raise input_error(run.folder, problem, "the run of a kernel that samples the posterior", "track again with --kernel tempered, for one")


def _of_few(source: SavedRun, options: Options) -> str:
    """Return what a user should know about smoothing a thinned run.

    Raises:
        InputError: the paths would follow ancestors, which are unknown.
    """
    problem = f"only {source.kept} of {source.kernel['particles']} particles of a frame are stored"
    if source.model.transition.frames_read is None or options.start == "particles":
        whole_run = "put the runs together with --keep all" if source.chains else "track again without --keep"
        remedy = "smooth with --start ensemble" if options.start == "particles" else whole_run
        raise input_error(source.folder, problem, f"all of them: the paths follow the filter's ancestors; or {remedy}", remedy)
    return f"note: {problem}; the paths are laid from these."


def _continued(settings: SmoothSettings) -> Record | None:
    """Return the tables of the smoothed run that is to be continued; None if a new one is started."""
    if settings.resume and (settings.out / RUN_FILE).exists():
        record = read_run_file(settings.out)
        if record.get("chains"):
            raise input_error(settings.out, "smoothed runs that were put together", "a smoothed run", COMBINE_AGAIN)
        if not record.get("smoothing"):
            raise input_error(settings.out, "the run of a filter", "a smoothed run", "name another folder with --out")
        return record
    refuse_occupied(settings.out)
    return None


def _record(source: SavedRun, filtered: FrameFiles, options: Options | JointOptions, seed: int) -> Record:
    """Return the tables of `run.toml`: those of the filter's run, and how it was smoothed."""
    record = {name: table for name, table in read_run_file(source.folder).items() if name not in ("check", "chains")}
    origin = {"folder": str(source.folder.resolve()), "run": source.id, "last": filtered.last_digest, "frames": len(filtered)}
    return {**record, **computing_here(), "smoothing": {**origin, "seed": seed, **options.model_dump()}}


def _begin(out: Path, before: Record | None, record: Record, show: Show, bar: bool) -> FrameFiles:
    """Write `run.toml`. Return the frames that are already stored, the last frame of the recording first."""
    frames = kept_frames(out, before, record, show, bar)
    if before is None:
        show(f"run        {out}")
    else:
        show(f"{out}: {len(frames)} of {record['smoothing']['frames']} frames exist")
        write_run_file(out, record)
    return frames


def _notes(source: SavedRun, joint: bool) -> list[str]:
    """Return what a user should know about this smoothing; `joint`: all frames are one Gaussian, and lost ones count with their images."""
    notes = []
    if source.model.transition.frames_read is None:
        notes.append(
            f"note: '{source.model.transition.name}' carries what it learned from all frames before. Its paths follow the filter's ancestors, "
            "and early frames have few distinct ones."
        )
    lost, restarted = source.summary.get("frames_lost"), source.summary.get("frames_restarted")
    if lost and not joint:
        notes.append(f"note: {lost} frames were lost. There the paths follow from the frames around them, not from the images.")
    if restarted:
        notes.append(
            f"note: the filter started anew in {frame_ranges(restarted)}. No path leads across: the parts before and after do not belong together."
        )
    return notes


def _again(source: SavedRun) -> str:
    return f"compute them again with `bayes-body track {source.settings['session']} --out {source.folder} --resume`"
