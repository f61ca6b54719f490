"""The driver of a study: it begins as many units as there are places, and lists the failures at the end. A failure stops nothing else.

The same call again continues: units that are done are skipped, those that were stopped go on after their last frame. Several drivers may share a
study: a unit that another process computes is looked at again later.
"""

import time
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

from bayes_body.base.errors import input_error
from bayes_body.runs.study.attempt import DIED, ELSEWHERE, Outcome
from bayes_body.runs.study.places import Places
from bayes_body.runs.study.records import STOPPED, UnitFiles
from bayes_body.runs.study.unit_process import Job
from bayes_body.runs.study.unit_queue import UnitQueue
from bayes_body.runs.study.units import Unit, is_finished, stored_frames
from bayes_body.view.study.rows import DONE, FAILED

# Seconds between looks at the frames of a unit that compiles, and at a unit that another process computes.
LOOK_S, AGAIN_S = 0.5, 5.0

type Show = Callable[[str], None]


class Share(NamedTuple):
    """What a unit gets of a machine.

    Attributes:
        cpus: number of cores.
        gpus: number of GPUs.
        retries: how often it may die without a new frame.
    """

    cpus: int = 1
    gpus: int = 0
    retries: int = 10


class Event(NamedTuple):
    """What the driver reports after a change.

    Attributes:
        done: units that are done.
        failed: units that have failed.
        running: units that run now.
        units: all units.
        unit: the unit that has ended; None if none has.
        sentence: why it failed; empty otherwise.
    """

    done: int
    failed: int
    running: int
    units: int
    unit: Unit | None
    sentence: str = ""


class Driver:
    """Computes the units of a study.

    Args:
        units: all units.
        out: the folder of the study.
        places: where they run.
        share: what each gets.
        show: receives lines for the user.
        on_event: called after each change, and about twice a second while nothing changes.
    """

    def __init__(self, units: list[Unit], out: Path, places: Places, share: Share, show: Show, on_event: Callable[[Event], None]):
        self._units, self._out, self._places, self._share = units, out, places, share
        self._show, self._on_event = show, on_event
        self._done = {unit.key for unit in units if self._is_done(unit)}
        self._queue = UnitQueue([unit for unit in units if unit.key not in self._done], self._done)
        self._running: dict[str, Unit] = {}
        # The frames that a unit had stored when it began to compile.
        self._stored_before: dict[str, int] = {}
        self._later: list[tuple[float, Unit]] = []
        self._deaths: dict[str, tuple[int, int]] = {}
        self._is_described = False
        self.failures: dict[str, str] = {}

    @property
    def done(self) -> set[str]:
        """Keys of the units that are done."""
        return self._done

    def run(self) -> None:
        """Compute all units that are not done. At Ctrl-C, those that run are stopped in order, and their frames are kept.

        Afterwards the places may be used again.
        """
        try:
            while self._queue or self._running or self._later:
                self._begin_units()
                self._look_at_compiling()
                outcomes = self._places.ended(LOOK_S)
                for outcome in outcomes:
                    self._take(outcome)
                if not outcomes:
                    self._report(None)
        except BaseException:
            self._places.stop()
            raise

    def _is_done(self, unit: Unit) -> bool:
        record = UnitFiles(self._out, unit.session, unit.name).read()
        return record is not None and record.state == DONE and record.work == unit.work and is_finished(unit)

    def _begin_units(self) -> None:
        self._places.expect(len(self._units) - len(self._done) - len(self.failures))
        time_s = time.monotonic()
        for due, unit in [entry for entry in self._later if entry[0] <= time_s]:
            self._later.remove((due, unit))
            self._queue.put(unit)
        while len(self._running) < self._places.capacity():
            following = self._queue.take()
            if following is None:
                return
            unit, is_first = following
            self._running[unit.key] = unit
            if is_first:
                self._stored_before[unit.key] = stored_frames(unit.folder)
            self._places.submit(self._job(unit, is_first))

    def _job(self, unit: Unit, is_first: bool) -> Job:
        share = self._share
        return Job(
            out=str(self._out),
            session=unit.session,
            name=unit.name,
            commands=unit.commands,
            folder=str(unit.folder),
            digest=unit.digest,
            work=unit.work,
            results=unit.results,
            cpus=share.cpus,
            gpus=share.gpus,
            wide=is_first,
            retries=share.retries,
            counts_parents=self._places.counts_parents,
        )

    def _look_at_compiling(self) -> None:
        """Let others begin once the first unit of their shape has stored a new frame."""
        for unit in self._queue.compiling:
            if not unit.is_closing and stored_frames(unit.folder) > self._stored_before[unit.key]:
                self._queue.has_compiled(unit)
                self._places.measure()
                self._describe()

    def _describe(self) -> None:
        if not self._is_described:
            self._is_described = True
            self._show(f"places     {self._places.describe()}")

    def _take(self, outcome: Outcome) -> None:
        unit = self._running.pop(outcome.key)
        self._queue.leave(unit, outcome.state == DONE, outcome.state in (DONE, FAILED))
        if outcome.state == DONE:
            self._done.add(unit.key)
            self._describe()
        elif outcome.state == ELSEWHERE:
            self._later.append((time.monotonic() + AGAIN_S, unit))
        elif outcome.state == DIED and self._may_retry(unit):
            self._show(f"{unit.key}: {outcome.sentence} It begins again after its last frame.")
            self._queue.put(unit)
        elif outcome.state != STOPPED:
            self.failures[unit.key] = outcome.sentence
        self._report(unit)

    def _may_retry(self, unit: Unit) -> bool:
        """Count the deaths without a new frame, here too: a process that dies at once leaves no trace on the disk."""
        frames = stored_frames(unit.folder)
        earlier_frames, deaths = self._deaths.get(unit.key, (0, 0))
        deaths = 1 if frames > earlier_frames else deaths + 1
        self._deaths[unit.key] = frames, deaths
        return deaths <= self._share.retries

    def _report(self, unit: Unit | None) -> None:
        sentence = self.failures.get(unit.key, "") if unit is not None else ""
        self._on_event(Event(len(self._done), len(self.failures), len(self._running), len(self._units), unit, sentence))


def check_digests(units: list[Unit], out: Path) -> None:
    """Refuse a study that asks for other results than those that are in its folder.

    Raises:
        InputError: a unit was made by other options, or of another session.
    """
    for unit in units:
        record = UnitFiles(out, unit.session, unit.name).read()
        if record is None or unit.is_closing or record.digest == unit.digest or not (unit.folder / "run.toml").exists():
            continue
        problem = f"{unit.folder} was made with other options, or its session has changed since"
        remedy = f"name another folder with --out, or remove {out / unit.session} to make its runs again"
        raise input_error(out, problem, "the options of the runs that it has", remedy)
