"""Write the tables of options in the guide from the schemas: `python docs/option_tables.py`."""

import re
from pathlib import Path

from pydantic import BaseModel

from bayes_body.base.registry import find, names
from bayes_body.base.toml.options import options_table
from bayes_body.model.definition import DetectorsTable, FirstTable
from bayes_body.model.likelihood.edge_phase import Scale
from bayes_body.model.potentials.kinematic import Component
from bayes_body.runs.study.cluster_file import ClusterFile, CondorTable, QueueTable, SlurmTable, SSHTable
from bayes_body.runs.study.study_file import StudyFile, TrackTable

GUIDE = Path(__file__).parent / "guide"
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
TABLES = {"The first pose": FirstTable, "Detectors": DetectorsTable, "`[[likelihood.scale]]`": Scale, "`[[potential.component]]`": Component}


def schemas() -> dict[str, dict[str, type[BaseModel]]]:
    """Return, for each page, the schema of each section that has a table of options, by its heading."""
    return {
        "definitions.md": definition_schemas(),
        "studies.md": {"Keys of a study": StudyFile, "Options of `track`": TrackTable},
        "clusters.md": {
            "Keys of `lab.toml`": ClusterFile,
            "`[slurm]`": SlurmTable,
            "`[pbs]`, `[lsf]`, `[sge]`": QueueTable,
            "`[htcondor]`": CondorTable,
            "`[ssh]`": SSHTable,
        },
    }


def definition_schemas() -> dict[str, type[BaseModel]]:
    """Return the schemas of a definition's terms."""
    terms = {}
    for room, heading in HEADINGS.items():
        for name in names(room):
            written = heading.replace("constraint", "potential") if name in POTENTIALS else heading
            terms[written.format(name)] = find(room, name).options
    return terms | TABLES


def with_tables(page: str, text: str) -> str:
    """Return the text of a page with its tables of options as the schemas have them."""
    for heading, schema in schemas()[page].items():
        start = re.search(rf"^#+ {re.escape(heading)}$", text, re.MULTILINE)
        if start is None:
            raise SystemExit(f"{page}: there is no section '{heading}'; expected one for each term; add it with a table's head.")
        end = re.compile(r"^#+ ", re.MULTILINE).search(text, start.end())
        last = end.start() if end else len(text)
        if schema.model_fields:
            text = text[: start.end()] + ROWS.sub(lambda _, rows=_rows(schema): f"{rows}\n", text[start.end() : last], count=1) + text[last:]
    return text


def _rows(schema: type[BaseModel]) -> str:
    """Return a table's rows. The options of `track` that a study's file has too are in a table of their own."""
    rows = options_table(schema).split("\n")
    inherited = tuple(f"| `{key}` |" for key in TrackTable.model_fields) if schema is StudyFile else ()
    return "\n".join(row for row in rows if not row.startswith(inherited))


if __name__ == "__main__":
    for page in schemas():
        path = GUIDE / page
        path.write_text(with_tables(page, path.read_text(encoding="utf-8")), encoding="utf-8")
