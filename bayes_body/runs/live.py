"""Track a session while it is recorded: frame by frame, as a pose estimator writes the files of keypoints.

The run is that of the same files after the recording, bit for bit. No frame is left out: if the tracker is slower than the frames come, they wait,
and the run says how many. At the end, the session has the frames that came.
"""

import signal
import threading
from collections.abc import Generator, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import FrameType
from typing import Any

from bayes_body.base.errors import input_error
from bayes_body.base.files.lock import locked
from bayes_body.base.progress import waiting
from bayes_body.initial import Show
from bayes_body.recording.readers.keypoints.arriving import ArrivingKeypoints, arriving_keypoints
from bayes_body.recording.session.read import FILE_NAME, load_session
from bayes_body.recording.session.schema import MOST_FRAMES
from bayes_body.recording.session.session import Session
from bayes_body.results.storage.manifest import input_digests
from bayes_body.results.storage.names import DELAYS_FILE
from bayes_body.results.storage.run_file import write_run_file
from bayes_body.runs.delays import Delays, delay_lines
from bayes_body.runs.finish import remark_on_stop
from bayes_body.runs.progress import progress_bar
from bayes_body.runs.run import BegunRun, begin
from bayes_body.runs.settings import Chosen, Settings, choose, frames_from, stored_record
from bayes_body.tracking.draws import Draws
from bayes_body.tracking.observations import Observed, observe_keypoints
from bayes_body.tracking.track import Progress
from bayes_body.view.live import LivePage, served


def run_live(settings: Settings, show: Show, bar: bool) -> dict[str, Any]:
    """Track frames as they come, until none comes any more, or until Ctrl-C. Write everything as `run` does, without pictures.

    Args:
        settings: the settings of the run, with `live`.
        show: receives lines for the user.
        bar: whether to show the progress on standard error.

    Returns:
        the content of `summary.json`.

    Raises:
        InputError: as in `run`; a folder of keypoints is missing; no frame comes; the model needs pictures; or the port of the page is taken.
    """
    live = settings.live
    if live is None:
        raise input_error("live", "None", "where the frames come from", "give `live`, or use `run`")
    with locked(settings.out):
        stored_tables = stored_record(settings)
        chosen, recording = choose(settings, stored_tables), load_session(settings.session)
        file = settings.session / FILE_NAME if settings.session.is_dir() else settings.session
        with arriving_keypoints(recording, live.folder, live.wait_s) as arriving:
            first = _first_place(recording, chosen)
            with waiting(f"waiting for frame {recording.frame_number(first)}", bar):
                if arriving.wait_for(first) is None:
                    problem = f"frame {recording.frame_number(first)} did not come: {arriving.end}"
                    raise input_error(f"--live {live.folder}", problem, "the first frame to track", "check the folder, or give a longer --wait")
            arriving.extend_session(file)
            begun = begin(settings, stored_tables, chosen, load_session(settings.session), show, bar)
            delays = Delays(settings.out / DELAYS_FILE, begun.session.first_frame)
            try:
                draws = _track(begun, arriving, first, chosen.frames or MOST_FRAMES, delays, live.port, show, bar)
            finally:
                arriving.stop()
                arriving.extend_session(file)
            tracked = len(begun.frames)
            end = f"{tracked} frames were asked for" if tracked == chosen.frames else arriving.end
            figures = {**delays.figures(), "end": end, "missing": arriving.missing(range(first, first + tracked))}
        session = _note_end(begun, settings.out, file, chosen)
        summary = begun.finish(session, draws, show, bar, pictures=False, live=figures)
        for line in delay_lines(figures):
            show(line)
        return summary


def _first_place(recording: Session, chosen: Chosen) -> int:
    """Return the place of the first tracked frame in the session, which need not have it yet.

    Raises:
        InputError: the frame is before the session's first one.
    """
    if chosen.first_frame is None:
        return 0
    if chosen.first_frame < recording.first_frame:
        raise input_error("--first-frame", str(chosen.first_frame), f"{recording.first_frame}, the session's first, or later", "give a larger number")
    return chosen.first_frame - recording.first_frame


def _note_end(begun: BegunRun, out: Path, file: Path, chosen: Chosen) -> Session:
    """Write the recording as it is now, and the number of frames, into `run.toml`. Return the session that was tracked."""
    session = frames_from(load_session(file), chosen.first_frame, lambda _: None)
    text = {"text": file.read_text(encoding="utf-8-sig")}
    run = {**begun.record["run"], "frames": len(begun.frames)}
    write_run_file(out, {**begun.record, "run": run, "session": text, "inputs": input_digests(session)})
    return session


def _track(begun: BegunRun, arriving: ArrivingKeypoints, first: int, most: int, delays: Delays, port: int, show: Show, bar: bool) -> Draws:
    """Track the frames that come. `first` is the place of the run's first frame in the session; at most `most` frames are tracked."""
    out, done = begun.frames.folder.parent, len(begun.frames)
    page = LivePage(begun.model, begun.session)
    with remark_on_stop(begun.frames, out, show), served(page, port) as address, progress_bar(bar, done) as show_bar, _stopped_by_interrupt(arriving):
        show(f"live       {address} shows the last second; Ctrl-C ends the recording")

        def on_frame(progress: Progress) -> None:
            came = len(arriving.frames) - first
            delays.add(progress.frame - 1, arriving.frames[first + progress.frame - 1].appeared_s, came - progress.frame)
            page.add(progress, delays.latest())
            # The next frame is expected: a bar that is full would say that the work is done.
            show_bar(progress._replace(frames=came + 1))

        draws = begun.track(most, on_frame, arriving=_observed(begun, arriving, first, range(done, most)))
    if not len(begun.frames):
        raise input_error("--live", "no frame was tracked", "at least one", "let the pose estimator run, and track again")
    return draws


def _observed(begun: BegunRun, arriving: ArrivingKeypoints, first: int, frames: range) -> Generator[Observed]:
    """Yield the data of the frames as they come."""
    for frame in frames:
        if arriving.is_stopped or arriving.wait_for(first + frame) is None:
            return
        yield observe_keypoints(begun.session, begun.model, frame, arriving.keypoints(first + frame))


@contextmanager
def _stopped_by_interrupt(arriving: ArrivingKeypoints) -> Iterator[None]:
    """Within it, the first Ctrl-C ends the recording in order, and a second one does what it did before. A signal that is ignored stays so."""
    previous = signal.getsignal(signal.SIGINT)
    if threading.current_thread() is not threading.main_thread() or previous is signal.SIG_IGN:
        yield
        return

    def stop(number: int, frame: FrameType | None) -> None:
        signal.signal(signal.SIGINT, previous)
        arriving.stop()

    signal.signal(signal.SIGINT, stop)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, previous)
