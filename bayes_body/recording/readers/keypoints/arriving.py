"""The subject's keypoints of a session, frame by frame, while a pose estimator writes them: one folder of OpenPose's files per camera.

A thread waits for the files of the next frame, reads them, and finds the subject among the people as the importer does. So the keypoints are those
that an import of the same files has. A frame is there when every camera has a complete file. A camera without one is not waited for, and counts as
having seen nothing, if

- it has the file of a later frame (files are written in order),
- it does not have the file of the frame before either, and another camera has this frame, or
- another camera has had this frame for LATE_S.

A file that is not complete after LATE_S counts as missing. The recording ends when the tracker has waited in vain for a given time: the time in which
it compiles, or works on frames that came before, does not count.
"""

import threading
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from bayes_body.base.errors import input_error
from bayes_body.recording.readers.keypoints.arriving_folder import ArrivingFolder, read_complete
from bayes_body.recording.readers.keypoints.imported import keypoint_folders, subject_row, visible_people
from bayes_body.recording.readers.keypoints.person import People
from bayes_body.recording.readers.keypoints.series import KeypointSeries, PersonFollower, read_series, write_series
from bayes_body.recording.readers.keypoints.units import LARGEST_SHARE, are_shares
from bayes_body.recording.session.read import extend_session_file
from bayes_body.recording.session.session import Keypoints, Session, View

# Seconds between two looks for the next file.
POLL_S = 0.004
# Seconds that a frame waits for a camera after another one has it.
LATE_S = 1.0
STOPPED = "it was stopped"


class ArrivedFrame(NamedTuple):
    """The keypoints of one frame.

    Attributes:
        rows: of each camera that has keypoints, as an imported session stores them; NaN where not found.
        visibility: whether each of these cameras had its file.
        appeared_s: when the last camera's file was first seen, on the clock `time.monotonic`.
    """

    rows: Float[np.ndarray, "camera keypoint 3"]
    visibility: tuple[bool, ...]
    appeared_s: float


class ArrivingKeypoints:
    """The frames of a session from its first one on, as they appear. Made by `arriving_keypoints`.

    Attributes:
        session: the session as it was when the frames began to come.
        frames: the frames that have been read.
        wait_s: seconds that `wait_for` waits for a frame; then the recording has ended.
        end: why no further frame will be read, as the end of a sentence; empty while the thread waits for one.
    """

    def __init__(self, session: Session, folder: Path, wait_s: float):
        self.session, self.frames, self.end = session, list[ArrivedFrame](), ""
        self._views, self._folders = _sources(session, folder)
        self._names = _common_names(session, self._views)
        self.wait_s, self._late_s = wait_s, min(LATE_S, wait_s / 2)
        self._follower = PersonFollower([view.camera for view in self._views])
        self._error: Exception | None = None
        self._changed, self._stopped = threading.Condition(), threading.Event()

    def stop(self) -> None:
        """Read no further frame."""
        self._stopped.set()

    @property
    def is_stopped(self) -> bool:
        """Whether `stop` was called."""
        return self._stopped.is_set()

    def wait_for(self, frame: int) -> ArrivedFrame | None:
        """The frame, counted from the session's first one, as soon as it is there; None if it does not come.

        Raises:
            InputError: a file is complete and has no keypoints as OpenPose writes them, or others than the session's.
        """
        with self._changed:
            waited_until_s = time.monotonic() + self.wait_s
            while len(self.frames) <= frame and not self.end:
                # A long wait would not let Ctrl-C through on every platform.
                self._changed.wait(0.1)
                if len(self.frames) <= frame and time.monotonic() > waited_until_s:
                    self.end = f"no new file came for {self.wait_s:g} s"
                    self.stop()
            if len(self.frames) <= frame and self._error is not None:
                raise self._error
            return self.frames[frame] if len(self.frames) > frame else None

    def keypoints(self, frame: int) -> tuple[Keypoints | None, ...]:
        """The keypoints of a frame that has been read, for each camera of the session; None for a camera that did not see it."""
        arrived, points = self.frames[frame], dict[str, Keypoints]()
        for view, row, was_seen in zip(self._views, arrived.rows, arrived.visibility, strict=True):
            if was_seen:
                # The numbers that the file of keypoints gives back.
                stored = row.astype(np.float32).astype(np.float64)
                points[view.camera.name] = KeypointSeries(stored[None], self._names, 0).frame(0)
        return tuple(points.get(view.camera.name) for view in self.session.views)

    def missing(self, frames: range) -> dict[str, int]:
        """How many of some frames lack a camera's file, for the cameras that lack any."""
        counts = {view.camera.name: sum(not self.frames[k].visibility[c] for k in frames) for c, view in enumerate(self._views)}
        return {name: count for name, count in counts.items() if count}

    def extend_session(self, file: Path) -> None:
        """Write the frames that have been read into the session's files, as an import of the same files writes them.

        Args:
            file: the session's file.

        Raises:
            InputError: a file cannot be written.
        """
        frames = list(self.frames)
        count = max(len(frames), self.session.frames)
        for c, view in enumerate(self._views):
            points = np.tile([np.nan, np.nan, 0.0], (count, len(self._names), 1))
            points[: len(frames)] = [arrived.rows[c] for arrived in frames]
            path = self.session.keypoints_path(view)
            if path is not None:
                write_series(path, KeypointSeries(points, self._names, self.session.number(view, 0)))
        extend_session_file(file, count)

    def read_all(self) -> None:
        """Read frame after frame until stopped. This is the work of the thread."""
        end, error = STOPPED, None
        try:
            while (arrived := self._next(len(self.frames))) is not None:
                with self._changed:
                    self.frames.append(arrived)
                    self._changed.notify_all()
        except Exception as fault:
            end, error = "a file cannot be used", fault
        with self._changed:
            self.end, self._error = self.end or end, error
            self._changed.notify_all()

    def _next(self, frame: int) -> ArrivedFrame | None:
        """Wait for a frame and read it; None after `stop`."""
        numbers = [self.session.number(view, frame) for view in self._views]
        people, appeared_s = dict[int, People](), dict[int, float]()
        # When a camera had this frame, or a later one, for the first time.
        somewhere_s = None
        while not self._stopped.is_set():
            self._look(numbers, people, appeared_s)
            missing = [c for c in range(len(numbers)) if c not in people]
            past = {c for c in missing if c not in appeared_s and self._folders[c].is_past(numbers[c])}
            now_s = time.monotonic()
            if somewhere_s is None and (appeared_s or past):
                somewhere_s = now_s
            if somewhere_s is not None and all(self._is_given_up(c, numbers[c], c in past, now_s - appeared_s.get(c, somewhere_s)) for c in missing):
                return self._arrived(people, max(appeared_s.values(), default=now_s))
            self._stopped.wait(POLL_S)
        return None

    def _look(self, numbers: list[int], people: dict[int, People], appeared_s: dict[int, float]) -> None:
        """Look once for the file of each camera that is still missing."""
        for c, number in enumerate(numbers):
            if c in people or (path := self._folders[c].find(number)) is None:
                continue
            appeared_s.setdefault(c, time.monotonic())
            complete = read_complete(path)
            if complete is None:
                continue
            if len(complete) and complete.shape[1] != len(self._names):
                problem, expected = f"people with {complete.shape[1]} keypoints", f"{len(self._names)}, as in the session's keypoints"
                raise input_error(path, problem, expected, "use one network, or import the recording again")
            if are_shares([complete]):
                remedy = "write pixels; `--live` reads no shares of the image's sides"
                raise input_error(path, f"no coordinate above {LARGEST_SHARE:g}", "pixels", remedy)
            people[c] = complete

    def _is_given_up(self, c: int, number: int, is_past: bool, waited_s: float) -> bool:
        """Whether a camera is not waited for, given whether it has gone on to later frames, and how long the frame or its own file has been there."""
        folder = self._folders[c]
        if is_past:
            # The file may have appeared after the look for it and before the look for the next one.
            return folder.find(number) is None
        return waited_s > self._late_s or (folder.find(number) is None and number > folder.first and folder.find(number - 1) is None)

    def _arrived(self, people: Mapping[int, People], appeared_s: float) -> ArrivedFrame:
        nobody = np.zeros((0, 0, 3))
        groups = [visible_people(people.get(c, nobody)) for c in range(len(self._views))]
        (places,) = self._follower.follow([groups])
        sources = zip(self._views, groups, places, strict=True)
        rows = np.stack([subject_row(view.camera, group, place, len(self._names)) for view, group, place in sources])
        return ArrivedFrame(rows, tuple(c in people for c in range(len(self._views))), appeared_s)


@contextmanager
def arriving_keypoints(session: Session, folder: Path, wait_s: float) -> Iterator[ArrivingKeypoints]:
    """Yield the frames of a session as they appear; a thread reads them from the session's first frame on, whether it has them already or not.

    Args:
        session: the recording so far, with the keypoints of its first frame.
        folder: has a folder CAMERA_json, or CAMERA, of each camera of the session that has keypoints.
        wait_s: seconds without a new file after which the recording has ended.

    Raises:
        InputError: a folder is missing or has no files, or the session has no keypoints, or they cannot be read.
    """
    arriving = ArrivingKeypoints(session, folder, wait_s)
    thread = threading.Thread(target=arriving.read_all, name="keypoints", daemon=True)
    thread.start()
    try:
        yield arriving
    finally:
        arriving.stop()
        thread.join()


def _sources(session: Session, folder: Path) -> tuple[list[View], list[ArrivingFolder]]:
    """The cameras that have keypoints, and the folder of each."""
    folders, views = keypoint_folders(session, folder), [view for view in session.views if view.keypoints is not None]
    expected = "a folder CAMERA_json of OpenPose's files for each camera that has keypoints in the session"
    for view in views:
        if view.camera.name not in folders:
            raise input_error(f"--live {folder}", f"no folder of camera '{view.camera.name}'", expected, "check the path and the folders' names")
        if view.spans:
            problem = f"camera '{view.camera.name}' has `spans`: frames that were lost are known only of a finished video"
            raise input_error(f"--live {folder}", problem, "a camera whose frame k is file k + offset", "track without --live")
    return views, [ArrivingFolder(folders[view.camera.name]) for view in views]


def _common_names(session: Session, views: list[View]) -> tuple[str, ...]:
    """The names of the keypoints, which are in the same order in all cameras."""
    orders = {read_series(path).names for view in views if (path := session.keypoints_path(view)) is not None}
    if len(orders) != 1:
        problem = "cameras with keypoints in different orders" if orders else "its cameras have no keypoints"
        remedy = "import the recording when the files of its first frame are there"
        raise input_error(session.title, problem, "keypoints in one order", remedy)
    return orders.pop()
