"""A study from its file to its end: plan, places, driver, and the pages about it."""

import shlex
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

from bayes_body.base.errors import InputError, input_error
from bayes_body.base.progress import units_bar
from bayes_body.runs.people import Person, people_sessions
from bayes_body.runs.study.driver import Driver, Event, Share, Show, check_digests
from bayes_body.runs.study.host import cores, gpus
from bayes_body.runs.study.overview import Overview
from bayes_body.runs.study.people_pages import pages_units, people_groups
from bayes_body.runs.study.places import LocalPlaces, Places
from bayes_body.runs.study.status import read_study
from bayes_body.runs.study.study_file import StudyFile, write_study_file
from bayes_body.runs.study.units import Unit, check_names, session_folders, session_name, units_of

# Names of sessions that a sentence lists.
LISTED = 3
# Units whose commands a preview shows.
PREVIEWED = 4


def run_study(study: StudyFile, out: Path, show: Show, bar: bool) -> bool:
    """Compute a study, or go on with it. Return whether all its units are done.

    Args:
        study: with absolute paths; its sessions may be patterns.
        out: the folder of the study.
        show: receives lines for the user.
        bar: whether to show the progress on standard error.

    Raises:
        InputError: no session, two of one name, or a file that cannot be written; the cluster cannot be reached; the folder has other results.
    """
    out = out.resolve()
    study, units = plan(study, out, show)
    check_digests(units, out)
    _remark_on_earlier(study, out, show)
    write_study_file(study, out)
    overview = Overview(study, units, out)
    with places_of(study, units, out, show) as (places, share):
        stage = _Stage(out, places, share, overview, show, bar)
        driver = _drive(units, f"study      {_counted(study)}", stage)
        pages, failures = _people_pages(study, units, driver, stage)
    for key, sentence in (driver.failures | failures).items():
        show(f"failed     {key}: {sentence}")
    for sentence in overview.remarks():
        show(f"note: {sentence}")
    total = len(units) + len(pages)
    count = len(driver.done) + len(pages) - len(failures)
    show(f"{out}: {count} of {total} units are done; index.html, study.csv, study.toml")
    return count == total


class _Stage(NamedTuple):
    """Where units are computed, and who is told."""

    out: Path
    places: Places
    share: Share
    overview: Overview
    show: Show
    bar: bool


def _drive(units: list[Unit], title: str, stage: _Stage) -> Driver:
    """Compute units and write the pages about the study. Return the driver."""
    with _progress(stage.bar, len(units)) as progress:

        def on_event(event: Event) -> None:
            progress(event)
            stage.overview.note(event)

        driver = Driver(units, stage.out, stage.places, stage.share, stage.show, on_event)
        stage.show(f"{title}, {len(driver.done)} of {len(units)} units are done")
        try:
            driver.run()
        except (KeyboardInterrupt, SystemExit):
            stage.show(f"{stage.out}: stopped; {len(driver.done)} of {len(units)} units are done, and the same command again goes on.")
            raise
        finally:
            stage.overview.write()
    return driver


def _people_pages(study: StudyFile, units: list[Unit], tracking: Driver, stage: _Stage) -> tuple[list[Unit], dict[str, str]]:
    """Compute the pages of all people of the recordings. Return their units, and why some have failed."""
    done, failed = tracking.done, tracking.failures
    for group in people_groups(study, units, stage.out):
        if remark := group.remark(done, failed):
            stage.show(f"note: pages of all people of {group.title}: {remark}.")
    pages = pages_units(study, units, stage.out, done, failed)
    if not pages:
        return [], {}
    stage.overview.add(pages)
    driver = _drive(pages, f"people     {_plural(len(pages), 'set')} of pages of all people", stage)
    # What another process has not ended is missing too.
    missing = {unit.key: driver.failures.get(unit.key, "it was stopped.") for unit in pages if unit.key not in driver.done}
    return pages, missing


def plan(study: StudyFile, out: Path, show: Show) -> tuple[StudyFile, list[Unit]]:
    """Return the study with folders instead of patterns, and its units.

    Raises:
        InputError: no session, or two of one name.
    """
    notes: list[str] = []
    folders = session_folders(study.sessions, notes)
    for note in notes:
        show(f"note: {note}")
    if study.person is not None:
        folders = _people(folders, study.person, show)
    study = study.model_copy(update={"sessions": [str(folder) for folder in folders], "person": None})
    return study, units_of(study, out)


def _people(recordings: list[Path], person: Person, show: Show) -> list[Path]:
    """Return the sessions of the people of recordings. A recording without them is left out, unless it is the only one."""
    folders = list[Path]()
    for recording in recordings:
        try:
            folders += people_sessions(recording, person, show, bar=True)
        except InputError as error:
            if len(recordings) == 1:
                raise
            show(f"note: {recording} is left out: {error}")
    if not folders:
        raise input_error("person", f"{person}", "a recording with people in its keypoints", "import the recordings with keypoints")
    check_names(folders)
    return folders


def preview(study: StudyFile, out: Path, show: Show) -> None:
    """Show what a study would compute, and the job script of its cluster. Nothing is written.

    Raises:
        InputError: as in `run_study`.
    """
    out = out.resolve()
    study, units = plan(study, out, show)
    check_digests(units, out)
    show(f"study      {_counted(study)}: {len(units)} units in {out}")
    for unit in units[:PREVIEWED]:
        for command in unit.commands:
            show(f"{unit.key}: bayes-body {shlex.join(command)}")
    if len(units) > PREVIEWED:
        show(f"... and {len(units) - PREVIEWED} more units")
    for group in people_groups(study, units, out):
        show(f"then pages of all people of {group.title} in {group.folder}")
    if study.cluster is not None:
        from bayes_body.runs.study.cluster import job_script

        show(job_script(study))


@contextmanager
def places_of(study: StudyFile, units: list[Unit], out: Path, show: Show) -> Iterator[tuple[Places, Share]]:
    """Yield the places where the units of a study run, and what a unit gets of them.

    Raises:
        InputError: the cluster cannot be reached, or what it needs is not installed.
    """
    if study.cluster is not None:
        from bayes_body.runs.study.cluster import cluster_places

        with cluster_places(study, out, show) as places_and_share:
            yield places_and_share
        return
    devices = gpus() if study.gpus is None or study.gpus else []
    count = len(cores())
    # A number that depends on the study alone: draws of a run may depend on the number of devices that computed them.
    cpus = study.cpus or max(1, count // max(len(units), 1))
    most = len(devices) if devices else max(1, count // cpus)
    places = LocalPlaces(min(most, study.at_once or most), cpus)
    try:
        yield places, Share(cpus, 1 if devices else 0, study.retries)
    finally:
        places.stop()


def _remark_on_earlier(study: StudyFile, out: Path, show: Show) -> None:
    """Say which sessions of the folder's earlier study are not in this one."""
    try:
        earlier = read_study(out)
    except InputError:
        return
    missing = [session_name(Path(folder)) for folder in earlier.sessions if folder not in study.sessions]
    if missing:
        names = ", ".join(missing[:LISTED]) + (f" and {len(missing) - LISTED} more" if len(missing) > LISTED else "")
        show(f"note: {names}: in the earlier study of {out}, and not in this one; their runs stay, without a row in index.html.")


def _counted(study: StudyFile) -> str:
    parts = [_plural(len(study.sessions), "session")]
    if study.variant:
        parts.append(_plural(len(study.variant), "variant"))
    return " × ".join([*parts, _plural(study.runs, "run")])


def _plural(count: int, noun: str) -> str:
    return f"{count} {noun}{'s' if count != 1 else ''}"


@contextmanager
def _progress(bar: bool, units: int) -> Iterator[Callable[[Event], None]]:
    if not bar:
        yield lambda event: None
        return
    with units_bar(units) as move:
        yield lambda event: move(event.done + event.failed, f"{event.running} running" + (f", {event.failed} failed" if event.failed else ""))
