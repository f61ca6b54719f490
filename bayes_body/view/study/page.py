"""`index.html` of a study: a row for each session, that can be sorted and filtered. It opens without a network, and the pictures are files beside it.

All text that comes from files is escaped, and the page allows no other script than its own.
"""

import base64
import hashlib
import re
import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from html import escape
from importlib.resources import files
from pathlib import Path
from string import Template
from typing import NamedTuple
from urllib.parse import quote

from bayes_body.base.errors import printable
from bayes_body.base.files.atomic import write_text
from bayes_body.results.storage.names import person_number
from bayes_body.view.colours import person_ink
from bayes_body.view.study.rows import FAILED, STATES, PeopleLinks, StudyRow, people_links_of

FILE_NAME = "index.html"
# Between columns, `rem`.
GAP = 0.7
OPTION = re.compile(r"(--[a-z][a-z-]*)")


class Column(NamedTuple):
    """A column of the page.

    Attributes:
        title: its heading.
        kind: the CSS class of its cells; `n` for numbers.
        width: its least width, in the page's unit `rem`.
        share: its share of the width that is left.
        inside: returns the markup inside a row's cell; empty if there is nothing to show.
        value: returns the number by which a row is sorted; None for a column that is sorted by its text.
        sorts: whether a click on the heading sorts.
    """

    title: str
    kind: str
    width: float
    share: int
    inside: Callable[[StudyRow], str]
    value: Callable[[StudyRow], float | None] | None = None
    sorts: bool = True


def _escaped(text: str) -> str:
    return escape(printable(text))


def _in_format(field: str, form: str, factor: float | int = 1) -> Callable[[StudyRow], str]:
    def written(row: StudyRow) -> str:
        value = getattr(row, field)
        return "" if value is None else form.format(factor * value)

    return written


def _number(title: str, field: str, form: str, factor: float | int = 1) -> Column:
    """Return a column of numbers: those of a row's field, times a factor."""
    return Column(title, "n", 4.3, 0, _in_format(field, form, factor), lambda row: getattr(row, field))


def _picture(row: StudyRow) -> str:
    if not row.picture:
        return ""
    image = f'<img src="{_address(row.picture)}" alt="" width="120" height="68" loading="lazy" decoding="async">'
    return f'<a href="{_address(row.links[0].path)}">{image}</a>' if row.links else image


def _state(row: StudyRow) -> str:
    note = f"<small>{_escaped(row.note)}</small>" if row.note and row.state != FAILED else ""
    return f'<b class="{row.state}">{row.state}</b>{note}'


def _warning(row: StudyRow) -> str:
    """Return the most serious warning; of a failed session, why it failed, for which the column of states is too narrow."""
    if row.state == FAILED and row.note:
        return f'<span class="failed">{_escaped(row.note)}</span>'
    if not row.warning:
        return "" if row.warnings is None else '<span class="soft">none</span>'
    more = f' <span class="soft">and {row.warnings - 1} more</span>' if row.warnings and row.warnings > 1 else ""
    # An option is not broken at its hyphens.
    return f"<span>{OPTION.sub(r'<code>\1</code>', _escaped(row.warning))}</span>{more}"


def _session(row: StudyRow) -> str:
    links = " ".join(f'<a href="{_address(link.path)}">{_escaped(link.words)}</a>' for link in row.links)
    return f"<b>{_escaped(row.session)}</b>{f'<div>{links}</div>' if links else ''}"


def _person(row: StudyRow) -> str:
    """Return the person's colour in pictures of several people, and the number; nothing for a session that is not one of several people's."""
    number = person_number(row.session)
    return "" if number is None else f'<span style="color: {person_ink(number)}">\u25cf</span> {number}'


def _address(path: str) -> str:
    """Return a relative path as the address of a link; `./` keeps a name with a colon from being taken for a protocol."""
    return f"./{quote(path, errors='surrogateescape')}"


COLUMNS = (
    Column("", "", 7.6, 0, _picture, sorts=False),
    Column("session", "s", 13, 2, _session),
    Column("person", "t", 4.3, 0, _person, lambda row: person_number(row.session)),
    Column("variant", "t", 5.5, 1, lambda row: _escaped(row.variant)),
    Column("state", "t", 5.5, 1, _state, lambda row: STATES.index(row.state)),
    _number("frames", "frames", "{:,}"),
    _number("frames lost", "frames_lost", "{:,}"),
    _number("R\u2011hat, at most", "rhat", "{:.2f}"),
    _number("truth in 90\u00a0% intervals (%)", "coverage_90", "{:.0f}", 100.0),
    _number("error (mm)", "error_mm", "{:.1f}"),
    _number("minutes", "seconds", "{:,.1f}", 1 / 60),
    _number("seconds a frame", "seconds_per_frame", "{:.3g}"),
    Column("warnings", "w", 13, 4, _warning, lambda row: row.warnings),
)


def write_index(
    rows: Sequence[StudyRow],
    failures: Sequence[tuple[str, str]],
    folder: Path,
    title: str,
    counts: Mapping[str, int] | None = None,
    people: Sequence[PeopleLinks] = (),
) -> Path:
    """Write the page of a study, either completely or not at all. Return its path.

    Args:
        rows: a row for each session and variant, in the order of the study.
        failures: name and sentence of each failed unit.
        folder: the folder of the study, from which the paths in the rows lead.
        title: the heading.
        counts: how many units are in each state; left out by default.
        people: the pages of all people of each recording; by default those that are beside the page.

    Raises:
        InputError: the file cannot be written.
    """
    path = folder / FILE_NAME
    write_text(path, page(rows, failures, title, counts, people or [people_links_of("", folder, folder)]))
    return path


def page(
    rows: Sequence[StudyRow],
    failures: Sequence[tuple[str, str]],
    title: str,
    counts: Mapping[str, int] | None = None,
    people: Sequence[PeopleLinks] = (),
) -> str:
    """Return the page's HTML. Columns in which no row has anything are left out; the arguments are those of `write_index`."""
    package = files(__package__)
    script = package.joinpath("page.js").read_text(encoding="utf-8")
    markup = {column: [column.inside(row) for row in rows] for column in COLUMNS}
    columns = [column for column in COLUMNS if any(markup[column])]
    cells = ("".join(_cell(column, markup[column][place], row) for column in columns) for place, row in enumerate(rows))
    values = {
        "title": _escaped(title),
        "columns": " ".join(f"minmax({column.width:g}rem, {column.share}fr)" if column.share else f"{column.width:g}rem" for column in columns),
        "least_width": f"{sum(column.width + GAP for column in columns):g}rem",
        "gap": f"{GAP}rem",
        "counted": _counted(rows, counts),
        "people": _people(people),
        "failures": _failures(failures),
        "states": _state_buttons(rows),
        "head": "".join(map(_heading, columns)),
        "rows": "\n".join(f'<tr data-state="{row.state}">{inside}</tr>' for row, inside in zip(rows, cells, strict=True)),
        "footer": f"Written {time.strftime('%Y-%m-%d %H:%M')} by bayes-body; reload the page for later figures. The same figures are in study.csv.",
        "script": script,
        "script_hash": f"sha256-{base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()}",
    }
    return Template(package.joinpath("page.html").read_text(encoding="utf-8")).substitute(values)


def _cell(column: Column, inside: str, row: StudyRow) -> str:
    value = column.value(row) if column.value else None
    sorting = "" if column.value is None else f' data-v="{"" if value is None else format(value, ".6g")}"'
    return f"<td{f' class={column.kind}' if column.kind else ''}{sorting}>{inside}</td>"


def _heading(column: Column) -> str:
    inside = f'<button type="button">{_escaped(column.title)}</button>' if column.sorts else ""
    return f'<th scope="col"{f" class={column.kind}" if column.kind == "n" else ""}>{inside}</th>'


def _counted(rows: Sequence[StudyRow], counts: Mapping[str, int] | None) -> str:
    sessions = len({row.session for row in rows})
    variants = len({row.variant for row in rows})
    parts = [f"{sessions:,} session{'s' * (sessions != 1)}", *([f"tracked in {variants} ways"] if variants > 1 else [])]
    if counts is not None:
        parts.append(f"{sum(counts.values()):,} units: " + ", ".join(f"{counts.get(state, 0):,} {state}" for state in reversed(STATES)))
    return "; ".join(parts) + "."


def _people(recordings: Sequence[PeopleLinks]) -> str:
    """Return what leads to the pages of all people: a line for one recording, a list for several."""
    shown = [recording for recording in recordings if recording.links or recording.remark]
    if not shown:
        return ""
    if len(recordings) == 1:
        return f"<p>All people: {_people_links(shown[0])}.</p>"
    items = "\n".join(f"<li><b>{_escaped(recording.title)}</b>: {_people_links(recording)}</li>" for recording in shown)
    return f"<details open><summary>All people of {len(shown):,} recording{'s' * (len(shown) != 1)}</summary><ul>\n{items}\n</ul></details>"


def _people_links(recording: PeopleLinks) -> str:
    links = [f'<a href="{_address(link.path)}">{_escaped(link.words)}</a>' for link in recording.links]
    return ", ".join([*links, *([_escaped(recording.remark)] if recording.remark else [])])


def _state_buttons(rows: Sequence[StudyRow]) -> str:
    numbers = Counter(row.state for row in rows)
    return "\n".join(
        f'<button type="button" data-state="{state}" aria-pressed="false"><b class="{state}">{numbers[state]:,}</b> {state}</button>'
        for state in reversed(STATES)
    )


def _failures(failures: Sequence[tuple[str, str]]) -> str:
    if not failures:
        return ""
    items = "\n".join(f"<li><b>{_escaped(name)}</b>: {_escaped(sentence)}</li>" for name, sentence in failures)
    return f'<details open><summary class="failed">{len(failures):,} failed</summary><ul>\n{items}\n</ul></details>'
