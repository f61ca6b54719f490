"""A complete run on disk: track a session, and write everything that is needed to inspect, repeat and continue it.

`run.toml` is written first, then each frame as it is computed, then the posterior, the figures and the pictures. If a run stops, its results so far
are kept. A later call continues it to the same result.
"""

from collections.abc import Mapping
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import jax

from bayes_body.base.errors import input_error
from bayes_body.base.files.lock import locked
from bayes_body.base.progress import waiting
from bayes_body.base.registry import find, notes
from bayes_body.initial import (
    Show,
    apply_first_pose,
    first_pose,
    first_pose_source,
    stored,
    unposed,
    with_first_keypoints,
)
from bayes_body.initial.search.automatic import check_pictures
from bayes_body.model.build import Model, build_model
from bayes_body.model.definition import load_definition
from bayes_body.model.kernel_options import kernel_of, kernel_options, kernel_sentences
from bayes_body.recording.session.read import load_session
from bayes_body.recording.session.session import Session
from bayes_body.results.metrics import true_markers
from bayes_body.results.metrics.plausibility import check_silhouettes, check_view, first_fit
from bayes_body.results.metrics.plausibility_sentences import fit_sentences
from bayes_body.results.posterior.thinning import thinning_of
from bayes_body.results.storage import FrameFiles
from bayes_body.results.storage.frame_files import Thinning
from bayes_body.results.storage.manifest import input_digests
from bayes_body.results.storage.names import RUN_FILE
from bayes_body.results.storage.results import Results
from bayes_body.results.storage.run_changes import refuse_changes
from bayes_body.results.storage.run_file import describe, write_run_file
from bayes_body.runs.finish import check_pairs, finish, kept_frames, remark_on_stop
from bayes_body.runs.progress import progress_bar
from bayes_body.runs.recovery import PersonRecovery
from bayes_body.runs.settings import AUTO, GIVEN, Record, Settings, choose, choose_model, frames_from, number_of_first, stored_record
from bayes_body.runs.size import check_size, disk_lines, draws_to_keep
from bayes_body.tracking.program import Ahead, compiled_ahead
from bayes_body.tracking.track import track
from bayes_body.view.figures_text import warning_line


def run(settings: Settings, show: Show, bar: bool, ahead: Ahead | None = None) -> dict[str, Any]:
    """Track and write everything. Return the content of `summary.json`.

    Args:
        settings: the settings of the run.
        show: receives lines for the user.
        bar: whether to show the progress on standard error.
        ahead: the program of a frame that is already being compiled (`compiled_ahead`), for a session of the same form. Without it, the program is
            compiled while the first pose is fitted or searched.

    Raises:
        InputError: an input cannot be used, the session has no first pose and none is found, the folder has another run or is used by another
            process, or a file cannot be written.
    """
    # The lock comes first: what another process writes after a look into the folder would not be noticed.
    with locked(settings.out):
        return _run(settings, show, bar, ahead)


def _run(settings: Settings, show: Show, bar: bool, ahead: Ahead | None) -> dict[str, Any]:
    before = stored_record(settings)
    chosen, whole = choose(settings, before), load_session(settings.session)
    session = frames_from(whole, chosen.first_frame, show)
    if chosen.init == AUTO:
        session = unposed(session)
    name = chosen.model or _chosen_model(session, show)
    definition = load_definition(name)
    model = build_model(definition, session)
    kind, options = kernel_options(definition, chosen.kernel, settings.overrides, (before or {}).get("kernel"), model.cameras)
    line, warning = kernel_sentences(definition, kind, model.cameras)
    if line and chosen.kernel is None:
        show(line)
    check_size(model, options.model_dump(), chosen.runs)
    # Everything that a user can correct is checked before the program is compiled.
    if chosen.init == GIVEN:
        session = with_first_keypoints(model, session)
    first_pose_table = (before or {}).get("first_pose")
    source = first_pose_source(model, session, first_pose_table)
    if source == "searched":
        check_pictures(model, session)
    if source != "stored":
        check_silhouettes(session, model)
    if source == "given":
        check_view(session, model)
    true_markers(session)
    recover = find("kernel", kind).recovers if chosen.recover is None else chosen.recover
    keep = draws_to_keep(chosen.keep, options.model_dump(), show)
    described = {"runs": chosen.runs, "seed": chosen.seed, "frames": chosen.frames, "init": chosen.init, "recover": recover, "keep": keep}
    described["first_frame"] = number_of_first(session, whole)
    record = describe(settings.session, name, definition, kind, options.model_dump(), described, input_digests(session))
    if before:
        refuse_changes(settings.out, before, record)
        # Its texts stay as they were: no number depends on what differs, but the run's id does.
        record = {**record, "definition": before["definition"]}
    remarks = check_pairs(session, model, chosen.frames or session.frames, show, bar)
    if warning:
        show(warning_line(warning))
        remarks = [warning, *remarks]
    kernel = kernel_of(kind, options)
    is_slow = source in ("fitted", "searched")
    compiling = compiled_ahead(session, model, kernel, options.particles, chosen.runs) if is_slow and ahead is None else nullcontext(ahead)
    with compiling as ahead, waiting("first pose: fitting the body to the first frame; the program compiles meanwhile", bar and is_slow):
        table_name = f"{settings.out / RUN_FILE}: first_pose"
        estimate = first_pose(model, session, source, show=show, seed=chosen.seed, table=first_pose_table, table_name=table_name)
        model = apply_first_pose(model, session, estimate)
    if source != "given":
        record = {**record, "first_pose": stored(model, estimate)}
    _show_first_fit(session, model, show)
    wanted, first = chosen.frames or session.frames, session.first_frame
    frames = _begin(settings.out, before, record, wanted, first, show, thinning_of(model.transition, keep))
    for line in disk_lines(settings.out, model, options.model_dump(), chosen.runs, wanted, len(frames), keep):
        show(line)
    for note in notes([("kernel", kind), *(("likelihood", term.kind) for term in definition.likelihoods)]):
        show(note)
    with remark_on_stop(frames, settings.out, show):
        with progress_bar(bar and len(frames) < (chosen.frames or session.frames), len(frames)) as on_frame:
            key, many = jax.random.key(chosen.seed), options.particles
            recovery = PersonRecovery(session, model, chosen.seed, show) if recover else None
            draws = track(key, session, model, kernel, many, chosen.runs, chosen.frames, on_frame, frames, ahead, recovery)
        results = Results(settings.out, frames)
        figures = {"kernel": kind, "seed": chosen.seed}
        return finish(session, draws, results, figures, remarks, show, bar, pictures=settings.pictures)


def _chosen_model(session: Session, show: Show) -> str:
    choice = choose_model(session)
    show(choice.sentence)
    return choice.model


def _show_first_fit(session: Session, model: Model, show: Show) -> None:
    """Show a warning before the tracking if the first pose does not fit the first frame, and a note if nothing tells."""
    figures = first_fit(session, model)
    for sentence in fit_sentences(figures):
        show(warning_line(sentence))
    if figures["fit_by"] is None:
        show(f"note: neither silhouettes nor keypoints tell whether the body is on the person in frame {session.first_frame}: look at the overlay.")


def _begin(
    out: Path, before: Mapping[str, Mapping[str, Any]] | None, record: Record, wanted: int, first: int, show: Show, thinning: Thinning | None
) -> FrameFiles:
    """Write `run.toml`. Return the frames that are already stored, up to the first damaged one."""
    frames = kept_frames(out, before, record, show, thinning)
    if before is None:
        return frames
    if len(frames) > wanted:
        raise input_error("--frames", str(wanted), f"at least the {len(frames)} frames that the run has", "give a larger number")
    if len(frames):
        where = f"continuing at frame {len(frames)} of {wanted}" + (f", number {first + len(frames)} of the recording" if first else "")
        what = where if len(frames) < wanted else f"all {wanted} frames exist, nothing is left to track"
        show(f"{out}: {what}")
    write_run_file(out, record)
    return frames
