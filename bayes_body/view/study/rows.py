"""A row of a study: what one session's runs are like, from the content of `summary.json`; and the same as a table (`study.csv`)."""

import csv
import io
import json
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from bayes_body.base.errors import InputError
from bayes_body.base.files.atomic import write_text
from bayes_body.base.files.read import read_text
from bayes_body.results.storage.names import OVERLAY_FILE, PEOPLE_REPORT_FILE, PEOPLE_VIEW_FILE, SUMMARY_FILE

# In the order in which somebody who watches a study looks for them.
FAILED, RUNNING, WAITING, DONE = STATES = ("failed", "running", "waiting", "done")
REPORT, VIEWER = "report.html", "view.html"
# The files of a run to which a row leads, and the words that do.
LINKED = ((REPORT, "report"), (VIEWER, "3D"), (OVERLAY_FILE, "video"))
# The files of all people of a recording together.
LINKED_PEOPLE = ((PEOPLE_REPORT_FILE, "report"), (PEOPLE_VIEW_FILE, "3D"), (OVERLAY_FILE, "video"))
LARGEST_SUMMARY_BYTES = 200_000_000


class Link(NamedTuple):
    """Words that lead to a file, and its path from the folder of the study."""

    words: str
    path: str


class PeopleLinks(NamedTuple):
    """Where the pages of all people of a recording are.

    Attributes:
        title: the recording, and the way to track it.
        links: the pages that exist.
        remark: who is not shown; may be empty.
    """

    title: str
    links: tuple[Link, ...]
    remark: str = ""


class StudyRow(NamedTuple):
    """What is shown of a session that was tracked in one way. A figure that does not exist is None.

    Attributes:
        session: the session's name.
        variant: the name of the way to track it; empty if there is only one.
        state: one of STATES.
        note: how far it is, or why it failed; may be empty.
        picture: path of a small picture from the folder of the study; empty if there is none.
        frames: number of frames.
        frames_lost: number of frames that a run could not explain.
        rhat: largest R-hat over the runs.
        coverage_90: share of the truth inside the 90 % intervals.
        error_mm: mean distance of the mean markers from the truth.
        seconds: time of all runs.
        seconds_per_frame: without compilation, all runs.
        warnings: number of warnings.
        warning: the most serious warning; empty if there is none.
        links: reports, viewers and videos that exist.
    """

    session: str
    variant: str = ""
    state: str = WAITING
    note: str = ""
    picture: str = ""
    frames: int | None = None
    frames_lost: int | None = None
    rhat: float | None = None
    coverage_90: float | None = None
    error_mm: float | None = None
    seconds: float | None = None
    seconds_per_frame: float | None = None
    warnings: int | None = None
    warning: str = ""
    links: tuple[Link, ...] = ()


def row_of(
    session: str,
    variant: str,
    summary: Mapping[str, Any],
    run_folder: Path,
    state: str,
    out: Path,
    *,
    note: str = "",
    runs: Sequence[Path] = (),
    picture: Path | None = None,
    seconds: float | None = None,
) -> StudyRow:
    """Return the row of a session.

    Args:
        session: the session's name.
        variant: the name of the way to track it; empty if there is only one.
        summary: the content of the run's `summary.json` (`read_summary`); empty if there is none yet.
        run_folder: the run whose figures are shown, such as that of all runs together.
        state: one of STATES.
        out: the folder of the study.
        note: how far it is, such as `40 of 300 frames`, or why it failed.
        runs: the folders of the single runs.
        picture: a small picture (`write_thumbnail`); left out if the file does not exist.
        seconds: time of all runs; by default that of the summary.
    """
    warnings = summary.get("warnings")
    listed = [str(sentence) for sentence in warnings] if isinstance(warnings, list) else []
    return StudyRow(
        session,
        variant,
        state,
        note,
        _path(picture, out) if picture is not None and picture.is_file() else "",
        _count(summary, "frames"),
        _count(summary, "frames_lost"),
        _number(summary, "rhat_max"),
        _number(summary, "coverage_90"),
        _number(summary, "error_mm_mean"),
        _number(summary, "seconds_total") if seconds is None else seconds,
        _number(summary, "seconds_per_frame"),
        len(listed) if summary else None,
        listed[0] if listed else "",
        links_of(run_folder, runs, out),
    )


def links_of(run_folder: Path, runs: Sequence[Path], out: Path) -> tuple[Link, ...]:
    """Return links to the files of a session's runs that exist: of the run that is shown, then of each single run by its number."""
    links = [Link(words, _path(run_folder / name, out)) for name, words in LINKED if (run_folder / name).is_file()]
    for number, folder in enumerate(runs, 1):
        if folder != run_folder:
            pages = ((REPORT, f"run {number}"), (VIEWER, f"run {number} in 3D"))
            links += [Link(words, _path(folder / name, out)) for name, words in pages if (folder / name).is_file()]
    return tuple(links)


def people_links_of(title: str, folder: Path, out: Path, remark: str = "") -> PeopleLinks:
    """Return links to the pages of all people that exist.

    Args:
        title: the recording, and the way to track it.
        folder: of the pages.
        out: the folder of the study.
        remark: who is not shown; may be empty.
    """
    return PeopleLinks(title, tuple(Link(words, _path(folder / name, out)) for name, words in LINKED_PEOPLE if (folder / name).is_file()), remark)


def read_summary(run_folder: Path) -> dict[str, Any]:
    """Return the content of a run's `summary.json`; empty if there is none that can be read."""
    path = run_folder / SUMMARY_FILE
    try:
        summary = json.loads(read_text(path, "the figures of a run", LARGEST_SUMMARY_BYTES))
    except (InputError, ValueError, RecursionError):
        return {}
    return summary if isinstance(summary, dict) else {}


def _path(file: Path, out: Path) -> str:
    return Path(os.path.relpath(file, out)).as_posix()


def _number(summary: Mapping[str, Any], key: str) -> float | None:
    value = summary.get(key)
    return float(value) if isinstance(value, int | float) and not isinstance(value, bool) else None


def _count(summary: Mapping[str, Any], key: str) -> int | None:
    value = _number(summary, key)
    return None if value is None else round(value)


# The columns of `study.csv`, and the fields of a row that they hold.
CSV_COLUMNS = {
    "session": "session",
    "variant": "variant",
    "state": "state",
    "note": "note",
    "frames": "frames",
    "frames_lost": "frames_lost",
    "rhat_max": "rhat",
    "coverage_90": "coverage_90",
    "error_mm": "error_mm",
    "seconds": "seconds",
    "seconds_per_frame": "seconds_per_frame",
    "warnings": "warnings",
    "warning": "warning",
}


def write_csv(rows: Sequence[StudyRow], path: Path) -> None:
    """Write `study.csv`, either completely or not at all: a line for each row; a figure that does not exist is an empty cell.

    Raises:
        InputError: it cannot be written.
    """
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(CSV_COLUMNS)
    for row in rows:
        values = (getattr(row, field) for field in CSV_COLUMNS.values())
        writer.writerow(f"{value:.6g}" if isinstance(value, float) else "" if value is None else value for value in values)
    write_text(path, text.getvalue())
