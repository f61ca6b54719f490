"""A complete run on disk: track a session, and write everything that is needed to inspect, repeat and continue it.

`run.toml` is written first, then each frame as it is computed, then the posterior, the figures and the pictures. If a run stops, its results so far
are kept. A later call continues it to the same result.
"""

from collections.abc import Callable, Generator, Mapping
from contextlib import nullcontext
from typing import Any, NamedTuple

import jax

from bayes_body.base.errors import input_error
from bayes_body.base.files.lock import locked
from bayes_body.base.progress import waiting
from bayes_body.base.registry import find, notes
from bayes_body.density.kernel import Kernel
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
from bayes_body.model.kernel_options import kernel_of, kernel_options, kernel_sentences, unknowns_sentence
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
from bayes_body.runs.device import device_lines
from bayes_body.runs.finish import check_pairs, finish, kept_frames, remark_on_stop
from bayes_body.runs.other_figures import observations_near_body
from bayes_body.runs.progress import progress_bar
from bayes_body.runs.recovery import PersonRecovery
from bayes_body.runs.settings import (
    AUTO,
    GIVEN,
    Chosen,
    Record,
    Settings,
    check_live,
    choose,
    choose_model,
    frames_from,
    number_of_first,
    stored_record,
)
from bayes_body.runs.size import check_size, disk_lines, draws_to_keep
from bayes_body.tracking.draws import Draws
from bayes_body.tracking.observations import Observed
from bayes_body.tracking.program import Ahead, compiled_ahead
from bayes_body.tracking.restarts import Recovery
from bayes_body.tracking.track import Progress, track
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
        before = stored_record(settings)
        chosen, recording = choose(settings, before), load_session(settings.session)
        begun = begin(settings, before, chosen, recording, show, bar, ahead)
        wanted, frames = chosen.frames or begun.session.frames, begun.frames
        with remark_on_stop(frames, settings.out, show):
            with progress_bar(bar and len(frames) < wanted, len(frames)) as on_frame:
                recovery = PersonRecovery(begun.session, begun.model, chosen.seed, show) if begun.recover else None
                draws = begun.track(wanted, on_frame, recovery)
            return begun.finish(begun.session, draws, show, bar, settings.pictures)


class BegunRun(NamedTuple):
    """A run whose `run.toml` is written, before its next frame.

    Attributes:
        session: the recording from the first tracked frame on.
        model: starts from the first pose.
        kernel: the kernel that tracks.
        kind: its name.
        particles: number of particles of a run.
        runs: number of independent filters.
        seed: seed of everything random.
        recover: whether a lost run looks for the person again.
        record: the tables of `run.toml`.
        remarks: warnings about the run, for its summary.
        frames: the stored frames.
        program: the program that is being compiled; None if it is not.
    """

    session: Session
    model: Model
    kernel: Kernel
    kind: str
    particles: int
    runs: int
    seed: int
    recover: bool
    record: Record
    remarks: list[str]
    frames: FrameFiles
    program: Ahead | None

    def track(
        self, wanted: int, on_frame: Callable[[Progress], None], recovery: Recovery | None = None, arriving: Generator[Observed] | None = None
    ) -> Draws:
        """Track the frames that are not stored yet (`tracking.track`)."""
        key = jax.random.key(self.seed)
        session, model, kernel = self.session, self.model, self.kernel
        if arriving is None:
            arriving = observations_near_body(session, model, kernel, range(len(self.frames), wanted), self.frames)
        return track(key, session, model, kernel, self.particles, self.runs, wanted, on_frame, self.frames, self.program, recovery, arriving)

    def finish(self, session: Session, draws: Draws, show: Show, bar: bool, pictures: bool, live: Mapping[str, Any] | None = None) -> dict[str, Any]:
        """Write posterior, summary and pictures (`finish`). `session` has all tracked frames."""
        results, figures = Results(self.frames.folder.parent, self.frames), {"kernel": self.kind, "seed": self.seed}
        return finish(session, draws, results, figures, self.remarks, show, bar, pictures=pictures, live=live)


def begin(
    settings: Settings, before: Record | None, chosen: Chosen, recording: Session, show: Show, bar: bool, ahead: Ahead | None = None
) -> BegunRun:
    """Choose the model, find the first pose, and write `run.toml`. The folder must be locked.

    Args:
        settings: the settings of the run.
        before: the tables of the run that is continued; None for a new one.
        chosen: the settings with their defaults.
        recording: the session.
        show: receives lines for the user.
        bar: whether to show the progress on standard error.
        ahead: as in `run`.

    Raises:
        InputError: as in `run`.
    """
    session = frames_from(recording, chosen.first_frame, show)
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
    recover = find("kernel", kind).recovers if chosen.recover is None else chosen.recover
    if chosen.live:
        check_live(model, session, source, recover)
    if source == "searched":
        check_pictures(model, session)
    if source != "stored":
        check_silhouettes(session, model)
    if source == "given":
        check_view(session, model)
    true_markers(session)
    keep = draws_to_keep(chosen.keep, options.model_dump(), show)
    described = {"runs": chosen.runs, "seed": chosen.seed, "frames": chosen.frames, "init": chosen.init, "recover": recover, "keep": keep}
    described |= {"first_frame": number_of_first(session, recording), "live": chosen.live or None}
    record = describe(settings.session, name, definition, kind, options.model_dump(), described, input_digests(session))
    if before:
        refuse_changes(settings.out, before, record)
        # Its texts stay as they were: no number depends on what differs, but the run's id does.
        record = {**record, "definition": before["definition"]}
    wanted = chosen.frames or session.frames
    remarks = check_pairs(session, model, wanted, show, bar)
    kernel_warnings = [sentence for sentence in (warning, unknowns_sentence(kind, options, [term.name for term in model.unknowns])) if sentence]
    for sentence in kernel_warnings:
        show(warning_line(sentence))
    remarks = [*kernel_warnings, *remarks]
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
    frames = _stored_frames(settings, before, record, wanted, session.first_frame, show, bar, thinning_of(model.transition, keep))
    for line in disk_lines(settings.out, model, options.model_dump(), chosen.runs, max(wanted, len(frames)), len(frames), keep):
        show(line)
    for line in device_lines():
        show(line)
    for note in notes([("kernel", kind), *(("likelihood", term.kind) for term in definition.likelihoods)]):
        show(note)
    return BegunRun(session, model, kernel, kind, options.particles, chosen.runs, chosen.seed, recover, record, remarks, frames, ahead)


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


def _stored_frames(
    settings: Settings,
    before: Mapping[str, Mapping[str, Any]] | None,
    record: Record,
    wanted: int,
    first: int,
    show: Show,
    bar: bool,
    thinning: Thinning | None,
) -> FrameFiles:
    """Write `run.toml`. Return the frames that are already stored, up to the first damaged one."""
    out = settings.out
    frames = kept_frames(out, before, record, show, bar, thinning)
    if before is None:
        return frames
    if len(frames) > wanted and not settings.live:
        problem, expected = str(wanted), f"at least the {len(frames)} frames that the run has"
        raise input_error("--frames", problem, expected, f"give a larger number{', or go on with --live' if before['run'].get('live') else ''}")
    if len(frames):
        number = f", number {first + len(frames)} of the recording" if first else ""
        goes_on = len(frames) < wanted or settings.live
        where = f"continuing at frame {len(frames)}{'' if settings.live else f' of {wanted}'}{number}"
        show(f"{out}: {where if goes_on else f'all {wanted} frames exist, nothing is left to track'}")
    write_run_file(out, record)
    return frames
