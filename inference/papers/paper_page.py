"""The stored page of a paper: every claim, what the paper reports for it, and what was measured here.

`inference/papers/PAPER/claims.toml` holds what the paper says, `docs/papers/figures/PAPER.json` the same with the measured values. The documentation
draws its tables from the latter (docs/paper_tables.py).
"""

import json
import tomllib
from collections.abc import Mapping
from pathlib import Path
from statistics import median
from typing import Any, Literal

from pydantic import BaseModel, computed_field

from bayes_body.base.errors import input_error, nearest
from bayes_body.base.files.atomic import write_text

PAPERS = Path(__file__).parent
STORED = PAPERS.parents[1] / "docs" / "papers" / "figures"
# A spread is that of at least so many seeds and subjects.
LEAST = 2


class Value(BaseModel):
    """One measured value. Facts of a model or of a learned file have neither a subject nor a seed."""

    subject: str | None = None
    seed: int | None = None
    value: float


class Figure(BaseModel):
    """One number of a row: what it is, in which unit, in the paper, as measured earlier, and as measured by the page's program."""

    name: str
    unit: str = ""
    paper: str = ""
    earlier: str = ""
    values: list[Value] = []

    @computed_field
    @property
    def median(self) -> float | None:
        """The median of the values."""
        return float(f"{median(value.value for value in self.values):.4g}") if self.values else None

    @computed_field
    @property
    def lowest(self) -> float | None:
        """The smallest value."""
        return min((value.value for value in self.values), default=None)

    @computed_field
    @property
    def highest(self) -> float | None:
        """The largest value."""
        return max((value.value for value in self.values), default=None)


class Row(BaseModel):
    """A claim of the paper.

    Attributes:
        name: for the command line.
        where: table, figure or page.
        claim: one sentence.
        differs: one sentence where this project does something else on purpose, or comes to something else.
        reason: why the claim is not measured.
        earlier: on which settings the figures called `earlier` were measured.
        command: what measures the row.
        picture: a file beside the stored page.
        figures: the numbers of the row.
        settings: the sizes of the measurement.
        versions: of what computed it.
        date: day of the last measurement.
    """

    name: str
    where: str
    claim: str
    differs: str = ""
    reason: str = ""
    earlier: str = ""
    command: str = ""
    picture: str = ""
    figures: list[Figure] = []
    settings: dict[str, Any] = {}
    versions: dict[str, str] = {}
    date: str = ""

    @computed_field
    @property
    def status(self) -> Literal["measured", "measured in part", "measured earlier", "not measured yet", "not reproduced"]:
        """Whether the row has values, and whether they tell a spread."""
        values = [value for figure in self.figures for value in figure.values]
        if self.reason:
            return "not reproduced"
        if not values:
            return "measured earlier" if self.earlier else "not measured yet"
        facts = all(value.seed is None for value in values)
        enough = all(len({getattr(value, name) for value in values}) >= LEAST for name in ("subject", "seed"))
        return "measured" if facts or enough else "measured in part"


class Page(BaseModel):
    """All rows of a paper."""

    paper: str
    title: str
    rows: list[Row]

    def row(self, name: str) -> Row:
        """Return a row by its name.

        Raises:
            InputError: there is none.
        """
        for row in self.rows:
            if row.name == name:
                return row
        raise input_error("row", repr(name), f"a row of {self.paper}", nearest(name, [row.name for row in self.rows]))


def load_claims(paper: str) -> Page:
    """Return the rows of a paper without measured values; `paper` is a name such as `poon_fleet_2002`."""
    document = tomllib.loads((PAPERS / paper / "claims.toml").read_text(encoding="utf-8"))
    # A TOML file names one row, and one figure, at a time.
    rows = [{**row, "figures": row.pop("figure", [])} for row in document.pop("row")]
    page = Page.model_validate(document | {"rows": rows})
    for row in page.rows:
        if not row.command and not row.reason:
            row.command = f"python inference/papers/{paper}.py --rows {row.name}"
    return page


def load_page(paper: str, path: Path) -> Page:
    """Return the claims of a paper as they are now, with the values that the stored page has for them.

    Raises:
        InputError: the stored page cannot be read.
    """
    page = load_claims(paper)
    if not path.exists():
        return page
    try:
        stored = Page.model_validate(json.loads(path.read_text(encoding="utf-8")))
    except ValueError as error:
        raise input_error(path, str(error).splitlines()[0], "a page that this program wrote", "remove the file") from None
    earlier = {row.name: row for row in stored.rows}
    for row in page.rows:
        if row.name in earlier:
            _take_values(row, earlier[row.name])
    return page


def _take_values(row: Row, stored: Row) -> None:
    values = {figure.name: figure.values for figure in stored.figures}
    for figure in row.figures:
        figure.values = values.get(figure.name, [])
    if any(figure.values for figure in row.figures):
        row.settings, row.versions, row.date = stored.settings, stored.versions, stored.date


def page_text(page: Page) -> str:
    """Return a page as it is stored."""
    return json.dumps(page.model_dump(), indent=1, ensure_ascii=False) + "\n"


def save_page(page: Page, path: Path) -> None:
    """Write a page.

    Raises:
        InputError: it cannot be written.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    write_text(path, page_text(page))


def is_measured(row: Row, settings: Mapping[str, Any], subject: str | None, seed: int | None) -> bool:
    """Whether a row has values of a subject and a seed, measured with these settings."""
    cases = {(value.subject, value.seed) for figure in row.figures for value in figure.values}
    return row.settings == dict(settings) and (subject, seed) in cases


def add_values(row: Row, settings: Mapping[str, Any], subject: str | None, seed: int | None, values: Mapping[str, float | None]) -> None:
    """Add the values of a subject and a seed to a row, by the names of its figures. None: this case has no such value.

    Values that were measured with other settings are dropped.
    """
    unknown = set(values) - {figure.name for figure in row.figures}
    if unknown:
        raise KeyError(f"{row.name} has no figure {sorted(unknown)}")
    if row.settings != dict(settings):
        for figure in row.figures:
            figure.values = []
    row.settings = dict(settings)
    for figure in row.figures:
        figure.values = [value for value in figure.values if (value.subject, value.seed) != (subject, seed)]
        if (number := values.get(figure.name)) is not None:
            figure.values.append(Value(subject=subject, seed=seed, value=float(f"{number:.4g}")))
