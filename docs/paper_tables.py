"""The tables of the papers' pages, drawn from the files that the programs of inference/papers/ write (docs/papers/figures)."""

import json
import re
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

# Where a page has its tables: `<!-- table: poon_fleet_2002 -->`, and `<!-- details: poon_fleet_2002 -->`.
MARK = re.compile(r"^<!-- (table|details): (\w+) -->$", re.MULTILINE)
HEADINGS = ("where", "what the paper says", "figure", "paper", "here")


def with_paper_tables(markdown: str, folder: Path) -> str:
    """Return the text of a page with the tables of the rows in place of its marks.

    Args:
        markdown: the text.
        folder: where the stored pages are.
    """

    def drawn(mark: re.Match[str]) -> str:
        page = json.loads((folder / f"{mark[2]}.json").read_text(encoding="utf-8"))
        return table(page["rows"]) if mark[1] == "table" else details(page["rows"])

    return MARK.sub(drawn, markdown)


def table(rows: Sequence[Mapping[str, Any]]) -> str:
    """Return one line for each figure of each row, beside the words of the row."""
    lines = [_line(_cell(heading, "th") for heading in HEADINGS)]
    for row in rows:
        figures = row["figures"] or [{}]
        differs = f" *Here:* {row['differs'] or row['reason']}" if row["differs"] or row["reason"] else ""
        words = [_cell(text, rows=len(figures)) for text in (f"[{row['where']}](#{anchor(row)})", row["claim"] + differs)]
        for figure in figures:
            numbers = [figure.get("name", ""), with_unit(figure.get("paper", ""), figure), here(row, figure)]
            lines.append(_line([*words, *map(_cell, numbers)]))
            words = []
    return "\n".join(['<table markdown="1">', *lines, "</table>"])


def _line(cells: Iterable[str]) -> str:
    return f'<tr markdown="1">{"".join(cells)}</tr>'


def _cell(text: str, tag: str = "td", rows: int = 1) -> str:
    span = f' rowspan="{rows}"' if rows > 1 else ""
    return f'<{tag} markdown="span"{span}>{text}</{tag}>'


def here(row: Mapping[str, Any], figure: Mapping[str, Any]) -> str:
    """Return what was measured for a figure: the median and the range, an earlier figure, or why there is none."""
    if row["status"] == "not reproduced":
        return "not measured"
    if figure.get("values"):
        spread = "" if len(figure["values"]) == 1 else f" ({number(figure['lowest'])} to {number(figure['highest'])})"
        return with_unit(f"**{number(figure['median'])}**{spread}", figure)
    if figure.get("earlier"):
        return with_unit(figure["earlier"], figure) + " (earlier)"
    return "not measured yet"


def details(rows: Sequence[Mapping[str, Any]]) -> str:
    """Return, for each row, its state, its command, its settings and its single values."""
    return "\n\n".join(f"### {row['where']}: {row['name']} {{ #{anchor(row)} }}\n\n" + "\n".join(_sentences(row)) for row in rows)


def _sentences(row: Mapping[str, Any]) -> list[str]:
    lines = [f"- {row['status'].capitalize()}."]
    if row["command"]:
        lines.append(f"- `{row['command']}`")
    if row["earlier"]:
        earlier = ", ".join(f"{figure['name']} {with_unit(figure['earlier'], figure)}" for figure in row["figures"] if figure["earlier"])
        lines.append(f"- Measured earlier: {earlier}. Settings: {row['earlier']}.")
    if row["settings"]:
        lines.append("- Settings: " + ", ".join(f"`{name}` {_plain(value)}" for name, value in row["settings"].items()) + ".")
    for figure in row["figures"]:
        if figure["values"]:
            lines.append(f"- {figure['name']}{f', {figure["unit"]}' if figure['unit'] else ''}: " + ", ".join(map(_single, figure["values"])) + ".")
    if row["date"]:
        lines.append(f"- {row['date']}, " + ", ".join(f"{name} {version}" for name, version in row["versions"].items()) + ".")
    if row["picture"] and row["date"]:
        lines.append(f"\n![{row['claim']}](figures/{row['picture']})")
    return lines


def _plain(value: Any) -> str:
    return ", ".join(map(str, value)) if isinstance(value, list) else str(value)


def _single(value: Mapping[str, Any]) -> str:
    case = "" if value["subject"] is None else f" (walk {value['subject']}, seed {value['seed']})"
    return f"{number(value['value'])}{case}"


def anchor(row: Mapping[str, Any]) -> str:
    """Return the anchor of a row's details."""
    return f"row-{row['name'].replace('_', '-')}"


def number(value: float) -> str:
    """Return a number with three digits, or four just above 1, where R-hats are; without an exponent for ordinary sizes."""
    if value == 0 or not 1e-3 <= abs(value) < 1e6:
        return f"{value:.3g}"
    digits = 4 if 1 < value < 1.1 else 3
    return f"{value:.0f}" if abs(value) >= 100 else f"{float(f'{value:.{digits}g}'):g}"


def with_unit(text: str, figure: Mapping[str, Any]) -> str:
    """Return a text with the figure's unit, if it ends with a number, a bracket or a mark of bold letters."""
    return f"{text} {figure['unit']}" if figure.get("unit") and re.search(r"[\d)*]$", text) else text
