"""Pages of all people of a recording: a video, a report and a 3D scene of everybody whom a study has tracked.

Their units follow all others, so that somebody whose run has failed is left out and stops nothing.
"""

from collections.abc import Collection, Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

from bayes_body.recording.session.people_folders import FOLDER, recording_folder
from bayes_body.results.storage.names import OVERLAY_FILE, PEOPLE_REPORT_FILE, PEOPLE_VIEW_FILE, SUMMARY_FILE, person_number
from bayes_body.runs.study.study_file import StudyFile, TrackTable
from bayes_body.runs.study.units import ALL_RUNS, Unit, digest_of, draws_pictures, final_folder, plugins_of, session_name

NAME = "pages"
# Pages of one person are those of the person's run.
FEWEST = 2


class TrackedPerson(NamedTuple):
    """A person of a recording in a study.

    Attributes:
        number: from 1 on.
        session: the name of the person's session.
        runs: the units that track.
        closing: the unit that follows them; None if there is none.
        folder: the run that the pages show.
    """

    number: int
    session: str
    runs: tuple[Unit, ...]
    closing: Unit | None
    folder: Path

    @property
    def label(self) -> str:
        """The name for readers."""
        return f"person {self.number}"

    def is_over(self, done: Collection[str], failed: Collection[str]) -> bool:
        """Whether nothing more will be computed of the person."""
        has_failed = any(run.key in failed for run in self.runs)
        is_closed = self.closing is None or has_failed or self.closing.key in done or self.closing.key in failed
        return is_closed and all(run.key in done or run.key in failed for run in self.runs)

    def is_tracked(self, done: Collection[str]) -> bool:
        """Whether the person has a finished run."""
        return all(run.key in done for run in self.runs) and (self.folder / SUMMARY_FILE).is_file()


class PeopleGroup(NamedTuple):
    """The people of a recording who are tracked in one way.

    Attributes:
        recording: the name of its folder.
        variant: the name of the way to track them; empty if there is only one.
        persons: by number.
        folder: of their pages.
    """

    recording: str
    variant: str
    persons: tuple[TrackedPerson, ...]
    folder: Path

    @property
    def title(self) -> str:
        """The recording and the way."""
        return f"{self.recording}, {self.variant}" if self.variant else self.recording

    def tracked(self, done: Collection[str]) -> list[TrackedPerson]:
        """Return those who have a finished run."""
        return [person for person in self.persons if person.is_tracked(done)]

    def remark(self, done: Collection[str], failed: Collection[str]) -> str:
        """Return who is not on the pages; empty if everybody is, or may still come."""
        missing = [person.label for person in self.persons if not person.is_tracked(done)]
        if not missing or not all(person.is_over(done, failed) for person in self.persons):
            return ""
        names = " and ".join(missing)
        if len(self.tracked(done)) < FEWEST:
            return f"none, because the tracking of {names} has failed"
        return f"without {names}, whose tracking has failed"


def people_groups(study: StudyFile, units: Sequence[Unit], out: Path) -> list[PeopleGroup]:
    """Return the people of every recording of which a study tracks two or more.

    Args:
        study: the study; its sessions are folders, no patterns.
        units: its units.
        out: its folder. Pages of a single recording are in it, those of several in a folder for each.
    """
    recordings: dict[str, Path] = {}
    for folder in map(Path, study.sessions):
        recording = recording_folder(folder)
        if recording is not None and person_number(folder.name) is not None:
            recordings[session_name(folder)] = recording
    members: dict[tuple[Path, str], dict[str, list[Unit]]] = {}
    for unit in units:
        if unit.session in recordings:
            members.setdefault((recordings[unit.session], unit.variant), {}).setdefault(unit.session, []).append(unit)
    crowds = {place: sessions for place, sessions in members.items() if len(sessions) >= FEWEST}
    groups = []
    for (recording, variant), sessions in crowds.items():
        persons = [_person(study, session, group, out) for session, group in sessions.items()]
        persons.sort(key=lambda person: person.number)
        folder = out if len(crowds) == 1 else out / f"{recording.name}_{FOLDER}" / variant
        groups.append(PeopleGroup(recording.name, variant, tuple(persons), folder))
    return groups


def _person(study: StudyFile, session: str, units: Sequence[Unit], out: Path) -> TrackedPerson:
    runs = tuple(unit for unit in units if not unit.is_closing)
    closing = next((unit for unit in units if unit.is_closing), None)
    prefix = f"{units[0].variant}_" if units[0].variant else ""
    folder = final_folder([run.folder for run in runs], out / session / f"{prefix}{ALL_RUNS}", "smooth" in study.steps)
    return TrackedPerson(person_number(session) or 0, session, runs, closing, folder)


def pages_units(study: StudyFile, units: Sequence[Unit], out: Path, done: Collection[str], failed: Collection[str]) -> list[Unit]:
    """Return a unit for the pages of every group of whom nothing more will be computed, and two or more are tracked.

    Args:
        study: the study; its sessions are folders, no patterns.
        units: its units.
        out: its folder.
        done: keys of the units that are done.
        failed: keys of those that have failed.
    """
    groups = [group for group in people_groups(study, units, out) if all(person.is_over(done, failed) for person in group.persons)]
    pages = (_unit(study, group, group.tracked(done), out) for group in groups if len(group.tracked(done)) >= FEWEST)
    return [unit for unit in pages if unit is not None]


def _unit(study: StudyFile, group: PeopleGroup, persons: Sequence[TrackedPerson], out: Path) -> Unit | None:
    table = next((variant for variant in study.variant if variant.name == group.variant), study)
    named_commands = dict(_commands(study, table, group.folder, [str(person.folder) for person in persons]))
    if not named_commands:
        return None
    commands = tuple(named_commands.values())
    # Of what the pages show, and of who is missing.
    work = digest_of(out, commands, *(run.work for person in persons for run in person.runs), *(person.session for person in group.persons))
    name = f"{group.variant}_{NAME}" if group.variant else NAME
    session = f"{group.recording}_{FOLDER}"
    return Unit(session, group.variant, name, commands, group.folder, f"{session}/{name}", "", work, results=tuple(named_commands))


def _commands(study: StudyFile, table: TrackTable, folder: Path, runs: Sequence[str]) -> Iterator[tuple[str, tuple[str, ...]]]:
    """Yield the files of the pages and the commands that write them. The report shows the pictures beside it, so these come first."""
    plugins = plugins_of(study, table)
    if draws_pictures(study, table):
        yield OVERLAY_FILE, ("overlay", *runs, "--out", str(folder / OVERLAY_FILE), "--overwrite", *plugins)
    if "report" in study.steps or "view" in study.steps:
        yield PEOPLE_REPORT_FILE, ("report", *runs, "--out", str(folder / PEOPLE_REPORT_FILE), *plugins)
        yield PEOPLE_VIEW_FILE, ("view", *runs, "--out", str(folder / PEOPLE_VIEW_FILE), *plugins)
