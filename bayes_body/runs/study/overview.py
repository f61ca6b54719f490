"""The pages about a study: `index.html` and `study.csv`, with a row for each session and variant. They are written again while the study runs."""

import time
from collections.abc import Iterable, Sequence
from contextlib import suppress
from pathlib import Path

from bayes_body.base.errors import InputError
from bayes_body.results.storage.names import SUMMARY_FILE
from bayes_body.runs.study.driver import Event
from bayes_body.runs.study.people_pages import people_groups
from bayes_body.runs.study.records import UnitFiles
from bayes_body.runs.study.status import WAITING, UnitState, blocked, counts_of, keys_of, state_of
from bayes_body.runs.study.study_file import StudyFile
from bayes_body.runs.study.units import Unit
from bayes_body.view.study.page import write_index
from bayes_body.view.study.rows import DONE, FAILED, RUNNING, StudyRow, people_links_of, read_summary, row_of, write_csv

CSV_FILE = "study.csv"
# The pages are written at most so often, and take at most this share of the driver's time.
LEAST_S, MOST_SHARE = 10.0, 0.02
# Units that a sentence lists.
LISTED = 3
# A unit compiles some programs of its own in any case.
FEW_PROGRAMS = 10


class Overview:
    """What is shown of a study.

    Args:
        study: the study.
        units: its units.
        out: its folder.
    """

    def __init__(self, study: StudyFile, units: list[Unit], out: Path):
        self._title, self._out = study.title or out.name, out
        self._states = {unit.key: state_of(unit, out) for unit in units}
        self._groups: dict[tuple[str, str], list[str]] = {}
        for unit in units:
            self._groups.setdefault((unit.session, unit.variant), []).append(unit.key)
        self._people = people_groups(study, units, out)
        # The rows of sessions in which nothing changes any more.
        self._rows: dict[tuple[str, str], StudyRow] = {}
        self._next = time.monotonic() + LEAST_S

    def add(self, pages: Iterable[Unit]) -> None:
        """Take the units of the pages of all people, which have no row."""
        self._states |= {unit.key: state_of(unit, self._out) for unit in pages}

    def note(self, event: Event) -> None:
        """Take a change from the driver, and write the pages if it is time. A disk that is full is no reason to stop."""
        if event.unit is not None:
            self._states[event.unit.key] = state_of(event.unit, self._out)._replace(**({"sentence": event.sentence} if event.sentence else {}))
        if time.monotonic() < self._next:
            return
        begun = time.monotonic()
        with suppress(InputError):
            self.write()
        self._next = begun + max(LEAST_S, (time.monotonic() - begun) / MOST_SHARE)

    def write(self) -> None:
        """Write both files.

        Raises:
            InputError: the file system refuses it.
        """
        for key, state in self._states.items():
            # A unit that runs now was waiting when it was looked at last.
            if state.state in (RUNNING, WAITING):
                self._states[key] = state_of(state.unit, self._out)
        failed = keys_of(self._states.values(), FAILED)
        self._states = {key: blocked(state, failed) for key, state in self._states.items()}
        rows = [self._row(session, variant, keys) for (session, variant), keys in self._groups.items()]
        failures = [(key, state.sentence) for key, state in self._states.items() if state.state == FAILED]
        write_csv(rows, self._out / CSV_FILE)
        done = keys_of(self._states.values(), DONE)
        people = [people_links_of(group.title, group.folder, self._out, group.remark(done, failed)) for group in self._people]
        write_index(rows, failures, self._out, self._title, counts_of(self._states.values()), people)

    def remarks(self) -> list[str]:
        """Return sentences about the study as a whole: whether compiled programs were used again."""
        # The first unit of a shape compiles.
        followers = [state for shape in self._by_shape().values() for state in shape[1:]]
        without = [state.unit.key for state in followers if not state.cached[0] and state.cached[1] > FEW_PROGRAMS]
        if not without:
            return []
        names = ", ".join(without[:LISTED]) + (f" and {len(without) - LISTED} more" if len(without) > LISTED else "")
        return [
            f"{names}: no compiled program came from the cache, so each unit compiled its own. JAX refuses its cache on some processors, and finds "
            "none in a home folder that cannot be written; JAX_COMPILATION_CACHE_DIR names another folder."
        ]

    def _by_shape(self) -> dict[str, list[UnitState]]:
        shapes: dict[str, list[UnitState]] = {}
        for state in self._states.values():
            if state.state == DONE:
                shapes.setdefault(state.unit.shape, []).append(state)
        for states in shapes.values():
            states.sort(key=lambda state: -state.cached[1])
        return shapes

    def _row(self, session: str, variant: str, keys: list[str]) -> StudyRow:
        row = self._rows.get((session, variant))
        if row is None:
            states = [self._states[key] for key in keys]
            row = row_of_states(states, self._out)
            if row.state == DONE:
                self._rows[session, variant] = row
        return row


def row_of_states(states: Sequence[UnitState], out: Path) -> StudyRow:
    """Return the row of a session and variant.

    Args:
        states: of its units; a closing unit is the last.
        out: the folder of the study.
    """
    state, note = _state(states)
    runs = [unit_state.unit.folder for unit_state in states if not unit_state.unit.is_closing]
    # All runs together, or the first run that has figures.
    folders = [states[-1].unit.folder, *runs]
    folder = next((folder for folder in folders if (folder / SUMMARY_FILE).is_file()), folders[0])
    pictures = [UnitFiles(out, unit_state.unit.session, unit_state.unit.name).picture for unit_state in reversed(states)]
    picture = next((path for path in pictures if path.is_file()), None)
    session, variant = states[0].unit.session, states[0].unit.variant
    seconds = sum(unit_state.seconds for unit_state in states)
    return row_of(session, variant, read_summary(folder), folder, state, out, note=note, runs=runs, picture=picture, seconds=seconds or None)


def _state(states: Sequence[UnitState]) -> tuple[str, str]:
    """Return the state of a session, and how far it is or why it failed."""
    by_state = {name: [state for state in states if state.state == name] for name in (FAILED, RUNNING, DONE, WAITING)}
    if by_state[FAILED]:
        first = by_state[FAILED][0]
        return FAILED, f"{first.unit.name}: {first.sentence}"
    if by_state[RUNNING]:
        return RUNNING, ", ".join(_progress(state) for state in by_state[RUNNING])
    if by_state[WAITING]:
        done = len(by_state[DONE])
        return WAITING, f"{done} of {len(states)} units are done" if done else ""
    return DONE, ""


def _progress(state: UnitState) -> str:
    if state.frames is None:
        return state.unit.name
    return f"{state.unit.name}: {state.frames}{f' of {state.unit.frames}' if state.unit.frames else ''} frames"
