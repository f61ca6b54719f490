"""Infer what is not known of a session from its keypoints, and write a session with the result.

Three filters go over the same frames, each in two runs: with the session's word, which gives the distances from the keypoints before; with unknowns,
where the difference of the runs shows how much is chance; and with the word of the new session, which gives the distances after.
"""

import json
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax

from bayes_body.base.errors import InputError, input_error
from bayes_body.base.files.atomic import write_text
from bayes_body.base.files.lock import locked
from bayes_body.base.progress import steps_bar
from bayes_body.initial import Show
from bayes_body.model.build import build_model
from bayes_body.model.definition import load_definition
from bayes_body.recording.readers.calibration.rewritten import rewrite_calibration
from bayes_body.recording.session.read import FILE_NAME, save_session
from bayes_body.recording.session.session import Session
from bayes_body.runs.unknowns.clocks import with_whole_frames
from bayes_body.runs.unknowns.definition import with_unknowns
from bayes_body.runs.unknowns.filters import expected_px, hold_unknowns, median_distances, prepare_filter, stretch_of
from bayes_body.runs.unknowns.fitted_session import fitted_session
from bayes_body.runs.unknowns.frames import Stretch, best_stretch, check_cameras, keypoints_of
from bayes_body.runs.unknowns.posterior import Posterior, as_json, posteriors_of
from bayes_body.runs.unknowns.remarks import farthest_runs, remarks_of
from bayes_body.runs.unknowns.table import fit_lines
from bayes_body.view.figures_text import warning_line
from bayes_body.view.fit_picture import Expected, draw_fit

CALIBRATION, HALF = "calibration", 0.5
PICTURE, FIT_FILE, MODEL, FRAMES, RUNS = "fit.png", "fit.json", "keypoints", 40, 2
DOING = ("the session as it is", "lengths, cameras and others unknown", "the new session")


@dataclass(frozen=True)
class FitSettings:
    """What to fit, and how.

    Attributes:
        out: folder of the new session.
        model: name or path of a definition that reads keypoints.
        frames: number of frames.
        delays: whether the cameras' delays are unknown, too.
        seed: seed of everything random.
    """

    out: Path
    model: str = MODEL
    frames: int = FRAMES
    delays: bool = False
    seed: int = 0


def fit(session: Session, settings: FitSettings, show: Show, bar: bool) -> dict[str, Any]:
    """Infer the unknowns of a session, show them, and write the new session. Return the content of `fit.json`.

    Args:
        session: the recording.
        settings: what to fit, and how.
        show: receives lines for the user.
        bar: whether to show the progress on standard error.

    Raises:
        InputError: fewer than two cameras have keypoints, a camera moves, the model does not read keypoints, the folder has a session, or a file
            cannot be read or written.
    """
    # What is left of a delay after a shift by whole frames is at most half a frame.
    definition = with_unknowns(load_definition(settings.model), HALF / session.fps if settings.delays else None)
    check_cameras(session)
    if settings.delays:
        session = with_whole_frames(session, show)
    stretch = best_stretch(session, build_model(definition, session).body.markers.names, settings.frames)
    with locked(settings.out):
        if (settings.out / FILE_NAME).exists():
            raise input_error(settings.out, f"already holds a {FILE_NAME}", "a folder without one", "name another with --out")
        show(_frames_line(session, stretch))
        key, part = jax.random.key(settings.seed), stretch_of(session, stretch)
        with steps_bar(len(DOING) * stretch.frames, DOING[0]) if bar else nullcontext(None) as step:
            filters = prepare_filter(definition, part, stretch, RUNS, show)
            model = filters.model(part)
            old_draws = filters.draws(key, part, hold_unknowns(model), _counting(step, 0, stretch))
            drawn = filters.draws(key, part, model, _counting(step, 1, stretch))
            posteriors = posteriors_of(model, drawn.frames[-1])
            new = fitted_session(session, settings.out, definition, posteriors)
            new_part = stretch_of(new, stretch)
            new_draws = filters.draws(key, new_part, hold_unknowns(filters.model(new_part)), _counting(step, 2, stretch))
        marker_names = model.body.markers.names
        keypoints = keypoints_of(part, marker_names)[list(stretch.indices)]
        expected_before, expected_after = expected_px(part, old_draws), expected_px(new_part, new_draws)
        before_px, after_px = median_distances(expected_before, keypoints), median_distances(expected_after, keypoints)
        remarks, names = [*_fitted_before(session), *remarks_of(posteriors, drawn, session)], [view.camera.name for view in session.views]
        _show(posteriors, names, before_px, after_px, remarks, show)
        distances = {name: {"before": b, "after": a} for name, b, a in zip(names, before_px, after_px, strict=True)}
        content = {
            "session": str(session.folder.resolve()),
            "model": definition.name,
            "seed": settings.seed,
            "frames": [part.frame_number(index) for index in stretch.indices],
            "unknowns": as_json(posteriors),
            "keypoints_px": distances,
            "warnings": remarks,
        }
        write_text(settings.out / FIT_FILE, json.dumps(content, indent=2) + "\n")
        save_session(new)
        middle = stretch.frames // 2
        states = [Expected("before", expected_before[middle], before_px), Expected("after", expected_after[middle], after_px)]
        with _left_out(PICTURE, show):
            draw_fit(settings.out / PICTURE, part, stretch.indices[middle], marker_names, keypoints[middle], states)
        if (calibration := session.calibration_path) is not None:
            imported, current = ([view.camera for view in recording.views] for recording in (session, new))
            with _left_out(f"{CALIBRATION}/", show):
                path = rewrite_calibration(calibration, settings.out / CALIBRATION, imported, current)
                show(f"calibration {path}: the new cameras for other programs")
    return content


@contextmanager
def _left_out(name: str, show: Show) -> Iterator[None]:
    """Within it, an error leaves out a file that the new session does not need."""
    try:
        yield
    except InputError as error:
        show(warning_line(f"{name} is not written: {error}"))


def _frames_line(session: Session, stretch: Stretch) -> str:
    first, last = (session.frame_number(index) for index in (stretch.first, stretch.first + stretch.span - 1))
    every = "" if stretch.step == 1 else f", one of {stretch.step}"
    return f"frames      {stretch.frames}, from {first} to {last}{every}: those in which two or more cameras see most"


def _fitted_before(session: Session) -> list[str]:
    if not (session.folder / FIT_FILE).exists():
        return []
    return ["this session was fitted before, and its standard deviations know the same keypoints: fit the session from which it was made."]


def _show(
    posteriors: dict[str, Posterior], cameras: Sequence[str], before_px: Sequence[float], after_px: Sequence[float], remarks: list[str], show: Show
) -> None:
    for line in fit_lines(posteriors, cameras, before_px, after_px):
        show(line)
    entry, disagreement = farthest_runs(posteriors)
    show("")
    show(f"agreement   the means of the two runs differ by at most {disagreement:.2f} standard deviations ({entry})")
    for sentence in remarks:
        show(warning_line(sentence))


def _counting(step: Callable[[int, str], None] | None, filters: int, stretch: Stretch) -> Callable[[int], None]:
    """Return what is called after each frame of a filter, after so many other filters."""

    def count(frames: int) -> None:
        if step:
            step(filters * stretch.frames + frames, DOING[min(filters + (frames == stretch.frames), len(DOING) - 1)])

    return count
