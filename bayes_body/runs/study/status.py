"""The state of a study, from what its units say on the disk."""

import time
from collections import Counter
from collections.abc import Iterable
from pathlib import Path
from typing import NamedTuple

from bayes_body.base.errors import input_error
from bayes_body.base.toml.read import read_toml, validate
from bayes_body.runs.study.people_pages import pages_units
from bayes_body.runs.study.records import UnitFiles
from bayes_body.runs.study.study_file import NAME, StudyFile
from bayes_body.runs.study.units import Unit, is_finished, stored_frames, units_of
from bayes_body.view.study.rows import DONE, FAILED, RUNNING, WAITING

# In the order in which they are counted.
STATES = (DONE, RUNNING, FAILED, WAITING)


class UnitState(NamedTuple):
    """How far a unit is.

    Attributes:
        unit: the unit.
        state: done, running, failed or waiting.
        sentence: why it failed, or where it runs, or why it waits; may be empty.
        frames: number of stored frames; None unless it runs or was stopped.
        seconds: of work so far.
        cached: programs that came from the cache, and those that were compiled.
    """

    unit: Unit
    state: str
    sentence: str = ""
    frames: int | None = None
    seconds: float = 0.0
    cached: tuple[int, int] = (0, 0)


def read_study(out: Path) -> StudyFile:
    """Return the study of a folder.

    Raises:
        InputError: the folder has none.
        FaultyFileError: its file has faults.
    """
    path = out / NAME
    if not path.is_file():
        problem = f"no {NAME} in it" if out.is_dir() else "no such folder"
        raise input_error(out, problem, "the folder of a study", "check the path; `bayes-body track SESSION SESSION ... --out FOLDER` makes one")
    return validate(StudyFile, read_toml(path), str(path))


def states_of(units: Iterable[Unit], out: Path) -> list[UnitState]:
    """Return the state of each unit, in their order."""
    states = [state_of(unit, out) for unit in units]
    failed = keys_of(states, FAILED)
    return [blocked(state, failed) for state in states]


def keys_of(states: Iterable[UnitState], name: str) -> set[str]:
    """Return the keys of the units in a state."""
    return {state.unit.key for state in states if state.state == name}


def state_of(unit: Unit, out: Path) -> UnitState:
    """Return the state of a unit."""
    files = UnitFiles(out, unit.session, unit.name)
    record = files.read()
    # A failure is one even if the session has changed since, or is gone.
    if record is None or (record.work != unit.work and record.state != FAILED):
        return UnitState(unit, WAITING)
    base = UnitState(unit, record.state, "", None, record.seconds, (record.cache_hits, record.cache_misses))
    if record.state == DONE:
        return base if is_finished(unit) else base._replace(state=WAITING, sentence="its results were removed; it is computed again")
    if record.state == FAILED:
        return base._replace(sentence=record.sentence)
    frames = stored_frames(unit.folder) if unit.digest else None
    if record.state == RUNNING and files.is_locked():
        return base._replace(sentence=f"on {record.host}", frames=frames, seconds=record.seconds + time.time() - record.begun)
    return base._replace(state=WAITING, sentence="stopped", frames=frames)


def blocked(state: UnitState, failed: set[str]) -> UnitState:
    """Return the state with a sentence if the unit waits for some that have failed."""
    causes = [key for key in state.unit.needs if key in failed]
    return state._replace(sentence=f"needs {', '.join(causes)}") if state.state == WAITING and causes else state


def counts_of(states: Iterable[UnitState]) -> dict[str, int]:
    """Return how many units are done, running, failed and waiting."""
    counts = Counter(state.state for state in states)
    return {name: counts[name] for name in STATES}


def status(out: Path) -> tuple[StudyFile, list[UnitState]]:
    """Return a study and the states of its units.

    Raises:
        InputError: the folder has no study.
    """
    out = out.resolve()
    study = read_study(out)
    units = units_of(study, out)
    states = states_of(units, out)
    pages = pages_units(study, units, out, *(keys_of(states, name) for name in (DONE, FAILED)))
    return study, [*states, *states_of(pages, out)]
