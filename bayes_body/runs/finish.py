"""The frames of a run on disk, and what it makes of them: posterior, figures, pictures.

What a run says about a likelihood that compares frames: where it is silent, and what in the recording misleads it.
"""

import json
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from bayes_body.base.errors import InputError, input_error
from bayes_body.base.files.atomic import remove_partial, write_text
from bayes_body.base.progress import waiting, watched
from bayes_body.initial import Show
from bayes_body.model.build import Model
from bayes_body.recording.observation.frame_pairs import pair_sentences
from bayes_body.recording.session.session import Session
from bayes_body.results.clinical.determined import undetermined_angles
from bayes_body.results.clinical.paths import sd_path
from bayes_body.results.clinical.ranges import range_figures, ranges_of
from bayes_body.results.clinical.trajectories import angle_paths
from bayes_body.results.metrics import summarise
from bayes_body.results.metrics.plausibility_sentences import fit_sentences
from bayes_body.results.metrics.unknown_sentences import unknown_sentences
from bayes_body.results.posterior import stream_posterior
from bayes_body.results.posterior.diagnostics import diagnose, sentences, worst_figures
from bayes_body.results.storage import FrameFiles
from bayes_body.results.storage.frame_files import Thinning
from bayes_body.results.storage.names import FRAMES_FOLDER, POSTERIOR_FILE, SUMMARY_FILE
from bayes_body.results.storage.results import Results
from bayes_body.results.storage.run_file import write_run_file
from bayes_body.runs.settings import Record
from bayes_body.tracking.draws import Draws
from bayes_body.view.figures_text import figures_text, warning_line
from bayes_body.view.overlay import VIDEO, draw_overlay, frames_drawn
from bayes_body.view.video import playing_rate


def kept_frames(
    out: Path, before: Mapping[str, Mapping[str, Any]] | None, record: Record, show: Show, bar: bool, thinning: Thinning | None = None
) -> FrameFiles:
    """Return the frames of a run that begins or goes on, up to the first damaged one. A new run's `run.toml` is written.

    Args:
        out: the folder of the run.
        before: the tables of the run that is continued; None for a new one.
        record: its tables now.
        show: receives lines for the user.
        bar: whether to show on standard error how many stored frames are read.
        thinning: what is stored of a frame; all of it by default.

    Raises:
        InputError: a frame belongs to another run, or a file cannot be written.
    """
    remove_partial(out)
    if before is None:
        return FrameFiles(out / FRAMES_FOLDER, write_run_file(out, record), thinning)
    frames = FrameFiles(out / FRAMES_FOLDER, before["check"]["run"], thinning)
    damage = frames.mend(watched("reading the stored frames", bar and len(frames) > 0))
    if damage:
        show(f"{damage} It is computed again.")
    return frames


@contextmanager
def remark_on_stop(frames: FrameFiles, out: Path, show: Show) -> Iterator[None]:
    """If the run stops early, tell the user how to continue it."""
    try:
        yield
    except BaseException:
        if len(frames):
            show(f"{out}: {len(frames)} frames are kept; the same command with --resume continues from there.")
        raise


def finish(
    session: Session,
    draws: Draws,
    results: Results,
    figures: Mapping[str, Any],
    remarks: list[str],
    show: Show,
    bar: bool,
    smoothed: bool = False,
    pictures: bool = True,
    live: Mapping[str, Any] | None = None,
    seeds: Sequence[int] = (),
) -> dict[str, Any]:
    """Write posterior, summary and pictures, unless they exist for these frames, and show figures and warnings. Return the content of the summary.

    At the end the frames' files are removed: their draws are in the posterior.

    Args:
        session: the recording.
        draws: the frames, in the order of time.
        results: what exists already.
        figures: the kernel and the seed, for posterior and summary.
        remarks: further warnings.
        show: receives lines for the user.
        bar: whether to show the progress on standard error.
        smoothed: whether a draw is a path through all frames.
        pictures: whether to draw the video and the stills, and to compare a body that was fitted to keypoints with the silhouettes. A later call may
            draw them.
        live: figures of a run whose frames came while they were tracked, for the summary.
        seeds: the seeds of runs that were put together, for the summary.

    Raises:
        InputError: a file cannot be read or written.
    """
    out = results.folder
    if not results.is_current(POSTERIOR_FILE):
        stream_posterior(draws, out / POSTERIOR_FILE, {**figures, **({"smoothed": 1} if smoothed else {})})
        results.add(POSTERIOR_FILE)
    if results.is_current(SUMMARY_FILE):
        summary = json.loads((out / SUMMARY_FILE).read_text(encoding="utf-8"))
    else:
        diagnosis, warnings = _diagnosed(results, bar)
        summary = summarise(session, draws, **figures, watch=watched("figures", bar), pictures=pictures) | diagnosis
        summary["angles"] = _angles(session, draws.model, results) if smoothed else None
        summary["frame_pairs"] = remarks
        if live is not None:
            summary["live"] = dict(live)
        if seeds:
            summary["seeds"] = list(seeds)
        summary["warnings"] = [*fit_sentences(summary), *remarks, *warnings, *unknown_sentences(summary)]
        write_text(out / SUMMARY_FILE, json.dumps(summary, indent=2) + "\n")
        results.add(SUMMARY_FILE)
    if pictures:
        _draw(session, draws, results, show, bar)
    _archive(results, smoothed, show, bar)
    show(figures_text(summary))
    for sentence in summary["warnings"]:
        show(warning_line(sentence))
    return summary


def _draw(session: Session, draws: Draws, results: Results, show: Show, bar: bool) -> None:
    """Draw the pictures, unless they exist. The run is complete without them: if they cannot be made, a note says why."""
    if results.is_drawn():
        return
    try:
        _, *stills = draw_overlay(session, draws, results.folder, watched("pictures", bar))
        results.add_pictures(stills)
    except InputError as error:
        show(f"note: no overlay: {error} The run is complete; the same command with --resume tries again to draw it.")
        return
    if (step := frames_drawn(len(draws.frames)).step) > 1:
        show(f"note: {VIDEO} shows one frame in {step}, so that drawing it does not take longer than the run.")
    elif (rate := playing_rate(session.fps)) != session.fps:
        show(f"note: {VIDEO} plays {rate:g} frames a second: players do not show the session's {session.fps:g}.")


def _archive(results: Results, smoothed: bool, show: Show, bar: bool) -> None:
    """Remove the frames' files, whose draws are in the posterior now. The run is complete with them too."""
    try:
        results.files.archive(smoothed, watched("reading the posterior back", bar))
    except InputError as error:
        show(f"note: the files of {FRAMES_FOLDER}/ stay: {error}")


def _diagnosed(results: Results, bar: bool) -> tuple[dict[str, Any], list[str]]:
    """The worst figures of the posterior's diagnostics, and the warnings."""
    with results.posterior() as tree, waiting("diagnostics", bar):
        diagnosis = diagnose(tree)
    # For a mode seeker the first sentence only says that it is one. The kernel's note before the run has already said so.
    return worst_figures(diagnosis), sentences(diagnosis)[diagnosis.mode_seeker :]


def _angles(session: Session, model: Model, results: Results) -> dict[str, Any]:
    """Peaks and ranges of motion of a smoothed run. The draws of a filter are no paths, and have none."""
    with results.posterior() as tree:
        up = "xyz".index(session.up)
        paths = angle_paths(tree, model, up, session.fps)
        return range_figures(ranges_of(paths), undetermined_angles(model, up, paths.labels, sd_path(paths.degrees)))


def check_pairs(session: Session, model: Model, frames: int, show: Show, bar: bool) -> list[str]:
    """Look at all pairs of frames, if a likelihood compares them. Show and return warnings about them.

    Raises:
        InputError: there is only one frame, and no likelihood that a single frame informs.
    """
    likelihoods, comparing = [factor for factor in model.factors if factor.side == "likelihood"], _comparing(model)
    if not comparing:
        return []
    if frames < 2 and len(comparing) == len(likelihoods):
        expected = f"two or more: {' and '.join(comparing)} compares a frame with the one before"
        raise input_error("frames", "one", expected, "track more frames, or add a likelihood of one frame to the model")
    others = (
        "only the other likelihoods inform it" if len(comparing) < len(likelihoods) else "its posterior is the first pose, spread by the motion prior"
    )
    show(f"{' and '.join(comparing)}: silent in frame {session.first_frame}, which has no frame before it: {others}.")
    sentences = pair_remarks(session, model, frames, bar)
    for sentence in sentences:
        show(warning_line(sentence))
    return sentences


def pair_remarks(session: Session, model: Model, frames: int, bar: bool) -> list[str]:
    """Return warnings about all pairs of frames, if a likelihood compares them."""
    return pair_sentences(session, frames, watched("pairs of frames", bar)) if _comparing(model) else []


def _comparing(model: Model) -> list[str]:
    return [factor.name for factor in model.factors if factor.side == "likelihood" and factor.reads_previous]
