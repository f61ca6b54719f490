"""Runs of several people of one recording, put together: who they are, in which frames they are there, and in which colours they are shown.

A person of a recording is a session of its own, in a folder `person_N`, with the cameras and the frame numbers of the recording. So the runs of
several people are compared by the numbers of their frames.
"""

import os
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from bayes_body.base.errors import input_error
from bayes_body.recording.session.people_folders import people_numbers, recording_folder
from bayes_body.recording.session.session import CameraSpec, Session
from bayes_body.results.posterior import CentralPose, central_pose
from bayes_body.results.posterior.blocks import pooled, pose_blocks, weights_of_runs
from bayes_body.results.posterior.resampling import RESAMPLING_SEED, systematic_resampling
from bayes_body.results.storage.names import person_number
from bayes_body.results.storage.run_file import check_plugins
from bayes_body.results.storage.saved_run import SavedRun, load_run
from bayes_body.view.colours import Colour, person_colour, person_ink

# Calibrations of the same cameras agree to this, in metres, pixels and entries of rotations: they may have been written with fewer digits.
SAME_CAMERA = 1e-6
TOGETHER = "give the runs that `bayes-body track SESSION --person all` made of one recording"


class Person(NamedTuple):
    """A person of a recording.

    Attributes:
        run: the run of the person, loaded from its folder.
        number: from 1 on; the name and the colour follow from it.
    """

    run: SavedRun
    number: int

    @property
    def name(self) -> str:
        """The name, such as `person_2`."""
        return f"person_{self.number}"

    @property
    def label(self) -> str:
        """The name for readers, such as `person 2`."""
        return f"person {self.number}"

    @property
    def colour(self) -> Colour:
        """The colour over images: red, green, blue."""
        return person_colour(self.number)

    @property
    def ink(self) -> str:
        """The colour in plots."""
        return person_ink(self.number)

    @property
    def frames(self) -> range:
        """The numbers in the recording of the frames in which the person is tracked."""
        return range(self.run.first_frame, self.run.first_frame + self.run.frames)

    def poses(self, numbers: range, draws: int) -> "Iterator[PersonPose]":
        """Yield the pose that stands for the posterior of each of the frames, and draws of equal weight; a mode seeker has none.

        Args:
            numbers: numbers of frames in which the person is there.
            draws: number of draws.
        """
        body, first = self.run.settled_model.body, self.run.first_frame
        indices = range(numbers.start - first, numbers.stop - first, numbers.step)
        for block in pose_blocks(self.run.tree, indices, variable=body.variable):
            for index, cloud, weights in zip(block.frames, pooled(block.poses), pooled(weights_of_runs(block.log_weights)), strict=True):
                shares, rng = weights / weights.sum(), np.random.default_rng([RESAMPLING_SEED, index])
                chosen = systematic_resampling(rng, shares, 0 if self.run.mode_seeker else draws)
                yield PersonPose(first + index, central_pose(body, cloud, shares), cloud[chosen])

    def part_of(self, numbers: range) -> range:
        """Return those of some frames of the recording, with any step, in which the person is there."""
        first = numbers.start + max(0, -(-(self.frames.start - numbers.start) // numbers.step)) * numbers.step
        return range(first, max(first, min(self.frames.stop, numbers.stop)), numbers.step)


class PersonPose(NamedTuple):
    """Where a person is in a frame.

    Attributes:
        frame: the number of the frame in the recording.
        central: the pose that stands for the posterior.
        draws: draws of equal weight, radians and metres.
    """

    frame: int
    central: CentralPose
    draws: Float[np.ndarray, "draw *shape"]


@dataclass(frozen=True)
class People:
    """Several people of one recording, in the order of their numbers.

    Attributes:
        persons: the people.
    """

    persons: tuple[Person, ...]

    @cached_property
    def frames(self) -> range:
        """The numbers of the frames from the first in which anybody is there to the last."""
        return range(min(person.frames.start for person in self.persons), max(person.frames.stop for person in self.persons))

    @cached_property
    def session(self) -> Session:
        """The recording from the first of these frames to the last: the session of the person who is there first, with all of the frames."""
        first = min(self.persons, key=lambda person: person.frames.start)
        session = first.run.session
        # A person's session has the recording's title, and who it is (readers/people/files.py).
        return replace(session, title=session.title.removesuffix(f", {first.label}"), frames=len(self.frames))

    @property
    def fps(self) -> float:
        """Frames a second."""
        return self.session.fps

    @property
    def name(self) -> str:
        """The name of the recording's folder, if the sessions are those of its people; else that of the folder that holds the runs."""
        return self.folder.name if self._recording is None else self._recording.name

    @cached_property
    def _recording(self) -> Path | None:
        """The recording's folder; None if a session is not that of a person of it, or if it is gone."""
        recordings = {recording_folder(person.run.session.folder.resolve()) for person in self.persons}
        return recordings.pop() if len(recordings) == 1 else None

    @property
    def missing(self) -> str:
        """A sentence on people of the recording of whom no run is among these; empty if there are none, or if the recording is not there."""
        shown = {person.number for person in self.persons}
        numbers = [] if self._recording is None else [number for number in people_numbers(self._recording) if number not in shown]
        return f"Not shown, for want of a finished run: {' and '.join(f'person {number}' for number in numbers)}." if numbers else ""

    @property
    def folder(self) -> Path:
        """The folder that holds all the runs, such as that of their study."""
        return Path(os.path.commonpath([person.run.folder.resolve().parent for person in self.persons]))

    def present(self, number: int) -> Iterator[tuple[Person, int]]:
        """Yield who is there in a frame of the recording, and the place of the frame in the person's run."""
        for person in self.persons:
            if number in person.frames:
                yield person, number - person.run.first_frame


@contextmanager
def open_people(folders: Sequence[Path]) -> Iterator[People]:
    """Yield the people of some runs' folders, and close the runs at the end.

    Raises:
        InputError: a run cannot be read, needs a plugin that is not loaded, or does not belong to the recording of the others.
    """
    with ExitStack() as stack:
        runs = [stack.enter_context(load_run(folder)) for folder in folders]
        for run in runs:
            check_plugins(run.folder, run.plugins)
        yield people_of(runs)


def people_of(runs: Sequence[SavedRun]) -> People:
    """Return the people of some runs. Names are those of the sessions' folders; if one has another name, people are numbered in the runs' order.

    Raises:
        InputError: there are fewer than two runs, two are of the same person, or one is of another recording.
    """
    if len(runs) < 2:
        remedy = "give the folders of two or more people's runs; the same command without a second one is for a single run"
        raise input_error("the runs", f"{len(runs)} run{'s' * (len(runs) != 1)}", "two or more, one for each person", remedy)
    first, *following = runs
    sessions: dict[Path, SavedRun] = {first.session.folder.resolve(): first}
    for run in following:
        _check_recording(first, run)
        twin = sessions.setdefault(run.session.folder.resolve(), run)
        if twin is not run:
            problem = f"a run of the same person as {twin.folder}"
            raise input_error(run.folder, problem, "a run for each person", "give one of them, or put them together with `bayes-body combine`")
    numbers = [person_number(run.session.folder.resolve().name) for run in runs]
    if None in numbers or len(set(numbers)) < len(runs):
        numbers = list(range(1, len(runs) + 1))
    persons = [Person(run, number) for run, number in zip(runs, numbers, strict=True) if number is not None]
    return People(tuple(sorted(persons, key=lambda person: person.number)))


def _check_recording(first: SavedRun, run: SavedRun) -> None:
    """Refuse a run that is not of the recording of the first one."""
    if run.fps != first.fps:
        problem, expected = f"{run.fps:g} frames a second", f"{first.fps:g}, as {first.folder} has"
        raise input_error(run.folder, problem, expected, TOGETHER)
    if run.session.up != first.session.up:
        raise input_error(run.folder, f"{run.session.up} points up", f"{first.session.up}, as in {first.folder}", TOGETHER)
    names, expected_names = ([view.camera.name for view in compared.session.views] for compared in (run, first))
    if names != expected_names:
        problem, expected = f"the cameras {', '.join(names)}", f"{', '.join(expected_names)}, as {first.folder} has"
        raise input_error(run.folder, problem, expected, TOGETHER)
    for view, expected_view in zip(run.session.views, first.session.views, strict=True):
        # The extrinsics of a moving camera in the session are those of its first frame, which is another one.
        moves = view.path is not None or expected_view.path is not None
        if not _is_same(view.camera, expected_view.camera, moves) or view.offset != expected_view.offset:
            problem = f"camera '{view.camera.name}' is calibrated otherwise, or has another offset"
            raise input_error(run.folder, problem, f"the camera of {first.folder}", TOGETHER)


def _is_same(a: CameraSpec, b: CameraSpec, moves: bool) -> bool:
    """Return whether two cameras have the same calibration; that of the lens for moving ones."""
    fields = ("size_px", "focal_px", "centre_px", "skew", "distortion", *(() if moves else ("rotation", "translation_m")))
    return all(np.allclose(getattr(a, field), getattr(b, field), rtol=0, atol=SAME_CAMERA) for field in fields)
