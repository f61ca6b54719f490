"""Write the tables of options in guide/definitions.md from the schemas: `python docs/option_tables.py`."""

import re
from pathlib import Path

from pydantic import BaseModel

from bayes_body.base.registry import find, names
from bayes_body.base.toml.options import options_table
from bayes_body.model.definition import FirstTable
from bayes_body.model.likelihood.edge_phase import Scale
from bayes_body.model.potentials.kinematic import Component

PAGE = Path(__file__).parent / "guide" / "definitions.md"
HEADINGS = {
    "dynamics": '`[dynamics] kind = "{}"`',
    "likelihood": '`[[likelihood]] kind = "{}"`',
    "observation": "`[likelihood.observation]` of `{}`",
    "potential": '`[[constraint]] kind = "{}"`',
    "unknown": '`[[unknown]] kind = "{}"`',
    "kernel": '`[kernel] kind = "{}"`',
}
# Terms of the room "potential" may be written under either name; the guide writes those of joints and parts as potentials.
POTENTIALS = ("kinematic", "penetration")
# The rows below a table's head.
ROWS = re.compile(r"(?<=\n\|---\|---\|---\|---\|\n)(?:\|.*\n)*")
TABLES = {"The first pose": FirstTable, "`[[likelihood.scale]]`": Scale, "`[[potential.component]]`": Component}


def schemas() -> dict[str, type[BaseModel]]:
    """Return the schema of each section that has a table of options, by its heading."""
    terms = {}
    for room, heading in HEADINGS.items():
        for name in names(room):
            written = heading.replace("constraint", "potential") if name in POTENTIALS else heading
            terms[written.format(name)] = find(room, name).options
    return terms | TABLES


def with_tables(text: str) -> str:
    """Return the page with its tables of options as the schemas have them."""
    for heading, schema in schemas().items():
        start = re.search(rf"^#+ {re.escape(heading)}$", text, re.MULTILINE)
        if start is None:
            raise SystemExit(f"{PAGE}: there is no section '{heading}'; expected one for each term; add it with a table's head.")
        end = re.compile(r"^#+ ", re.MULTILINE).search(text, start.end())
        last = end.start() if end else len(text)
        if schema.model_fields:
            text = text[: start.end()] + ROWS.sub(lambda _, rows=options_table(schema): f"{rows}\n", text[start.end() : last], count=1) + text[last:]
    return text


if __name__ == "__main__":
    PAGE.write_text(with_tables(PAGE.read_text(encoding="utf-8")), encoding="utf-8")
