"""Model definitions: read models/*.toml, by name or by path, and validate them.

A definition names terms. The registry provides the schema of each term's table. Nothing here builds arrays.
"""

import warnings
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, Field

from bayes_body.base.errors import FaultyFileError, InputError, RunWarning, input_error, nearest
from bayes_body.base.files.shipped import definitions_folder
from bayes_body.base.registry import EVIDENCE, OTHER, Room, find, names
from bayes_body.base.toml.read import parse_toml, read_toml, validate
from bayes_body.base.toml.schema import Finite, Positive, Schema
from bayes_body.model.body.schema import BodySchema

# How a state places the body: by joint angles, or by one rigid transform for each part.
PLACEMENTS = ("angles", "parts")


class TermTable(BaseModel):
    """A table with the `kind` of a term; its other keys are the term's options."""

    model_config = ConfigDict(extra="allow", frozen=True)
    kind: str

    @property
    def options(self) -> dict[str, Any]:
        """All keys except `kind`."""
        return dict(self.model_extra or {})


class FirstTable(Schema):
    """The table `[first]`: standard deviations of the first pose, by names of dofs or patterns. Dofs without one are certain.

    A pose that was fitted to the first frame's data is no prior for that frame, which would count these data twice. So deviations should be wide, and
    dofs that data hardly determine should begin at rest.
    """

    sd_deg: Mapping[str, Positive] = {}
    """[degrees] table: a dof's name or a pattern = its standard deviation, for angles."""
    sd_m: Mapping[str, Positive] = {}
    """[metres] the same for translations."""
    rest_deg: Mapping[str, Finite] = {}
    """[degrees] table: an angle that the first pose is drawn about, in place of the given or fitted one."""


type DetectorName = Literal["keypoints", "silhouettes", "standing", "faces", "limbs"]


class DetectorsTable(Schema):
    """The table `[detectors]`: what looks for the parts of a loose-limbed body in every frame. Detections say where to look, and are no evidence."""

    use: tuple[DetectorName, ...] = Field(min_length=1)
    """their names: `"limbs"` (segments of one colour in pairs of views), `"faces"` (heads), `"silhouettes"` (the visual hull), `"keypoints"`
    (those of the session, triangulated), `"standing"` (one camera's silhouette)"""


class _File(Schema):
    """The schema of a definition file whose terms are not validated yet."""

    title: str
    source: str
    body: dict[str, Any]
    dynamics: TermTable
    likelihoods: tuple[TermTable, ...] = Field(alias="likelihood", min_length=1)
    constraints: tuple[TermTable, ...] = Field(alias="constraint", default=())
    potentials: tuple[TermTable, ...] = Field(alias="potential", default=())
    unknowns: tuple[TermTable, ...] = Field(alias="unknown", default=())
    kernel: TermTable
    first: FirstTable = FirstTable()
    detectors: DetectorsTable | None = None


@dataclass(frozen=True)
class TermDefinition:
    """One term: its kind, and its validated options (the term's own pydantic model)."""

    kind: str
    options: Any


@dataclass(frozen=True)
class LikelihoodDefinition(TermDefinition):
    """A likelihood, and the options of its observation."""

    observation: Any


@dataclass(frozen=True)
class Definition:
    """A model definition: the text of its file, its title and source, a body, and terms with validated options.

    `placement` is `angles`, or `parts` for a loose-limbed body (model/body/placement.py). `first` says how uncertain the first pose is. `detectors`
    propose places of the parts to a kernel that takes proposals.
    """

    name: str
    text: str
    title: str
    source: str
    body_name: str
    body_text: str
    placement: str
    body: BodySchema
    dynamics: TermDefinition
    likelihoods: tuple[LikelihoodDefinition, ...]
    constraints: tuple[TermDefinition, ...]
    kernel: TermDefinition
    first: FirstTable = FirstTable()
    unknowns: tuple[TermDefinition, ...] = ()
    detectors: tuple[DetectorName, ...] = ()

    def takes_measures_of(self, body: str | None) -> bool:
        """Whether lengths and a first pose with the names of `body` (None: unknown) can be used for this definition's body."""
        return body in (None, self.body_name, self.body.measured_as)


# Models that were named after samplers: their names before, which still work, by today's.
FORMER_NAMES = {
    "deutscher_2005": "deutscher_apf",
    "keypoints": "markers_31",
    "legs_by_phase": "hmc_legs",
    "silhouette_pixels": "silhouette_31",
    "silhouettes": "tempered_smc",
    "walker_from_the_side": "hmc_walker",
}


def evidence_of(definition: Definition) -> list[str]:
    """Return what the definition's likelihoods compare the body with: `registry.EVIDENCE`, or `other` for a plugin's that does not say."""
    read = {evidence for term in definition.likelihoods for evidence in find("likelihood", term.kind).evidence(term.options)}
    return sorted(read, key=lambda evidence: (*EVIDENCE, OTHER).index(evidence))


def current_name(name: str) -> str:
    """Return today's name of a shipped model: of a former name that of its model, else the name itself."""
    return next((today for today, former in FORMER_NAMES.items() if former == name), name)


def definition_names(folder: str = "") -> tuple[str, ...]:
    """Return the names of the shipped models or, with `folder` = "bodies", of the shipped bodies."""
    return tuple(sorted(path.stem for path in (definitions_folder() / folder).glob("*.toml")))


def load_definition(name: str | Path) -> Definition:
    """Load a shipped definition by name, or a user's by path.

    Raises:
        InputError: there is none of that name, or the file is no TOML.
        FaultyFileError: one sentence for each thing in it that is wrong.
    """
    today = current_name(str(name))
    if today != str(name):
        warnings.warn(f"the model '{name}' is now called '{today}'; the former name will not work in the next release", RunWarning, stacklevel=2)
    path = _locate(today, "", "model", Path())
    subject = path.name if path.parent == definitions_folder() else str(path)
    # `read_toml` comes first: it raises an InputError if there is no such file.
    tables = read_toml(path)
    return _read(path.stem, path.read_text(encoding="utf-8-sig"), tables, _Collector(subject, path.parent))


def parse_definition(name: str, text: str, body_text: str | None, subject: str = "") -> Definition:
    """Read a definition from texts, such as those that a run stores, which may differ from the files.

    Args:
        name: name of the definition.
        text: text of the model file.
        body_text: text of the body file; without it, the body that the model names is looked up.
        subject: the name of the text in error messages; `name` by default.

    Raises:
        InputError: the text is not TOML.
        FaultyFileError: one sentence for each thing in it that is wrong.
    """
    subject = subject or name
    return _read(name, text, parse_toml(text, subject), _Collector(subject, Path(), body_text or None))


def _read(name: str, text: str, data: Mapping[str, Any], collect: "_Collector") -> Definition:
    file = collect.attempt(lambda: validate(_File, data, collect.subject))
    # Read directly from the tables, so that a fault in one place does not hide those in another.
    placement, table = collect.placement(data.get("body"))
    body_name, body_text, body = collect.body(table)
    likelihoods = tuple(collect.likelihood(index, table) for index, table in _tables(data.get("likelihood")))
    # Both keys name terms of the room "potential"; which side a term is on, it says itself.
    constraints = tuple(
        collect.term("potential", f"{key} #{index + 1}", table) for key in ("constraint", "potential") for index, table in _tables(data.get(key))
    )
    unknowns = tuple(collect.term("unknown", f"unknown #{index + 1}", table) for index, table in _tables(data.get("unknown")))
    collect.repeated("unknown", [term.kind for term in unknowns])
    (dynamics, kernel) = (next((collect.term(room, room, table) for _, table in _tables([data.get(room)])), None) for room in ("dynamics", "kernel"))
    collect.detectors(data.get("detectors"), placement)
    if collect.sentences or file is None or dynamics is None or kernel is None or body is None:
        raise FaultyFileError(collect.sentences)
    terms = dynamics, likelihoods, constraints, kernel, file.first, unknowns, file.detectors.use if file.detectors else ()
    return Definition(name, text, file.title, file.source, body_name, body_text, placement, body, *terms)


def _tables(value: Any) -> Iterator[tuple[int, TermTable]]:
    """Yield the tables of a list that name a term. The schema of the file reports the others."""
    for index, table in enumerate(value if isinstance(value, list) else []):
        if isinstance(table, dict) and isinstance(table.get("kind"), str):
            yield index, TermTable(**table)


def load_body(name: str, beside: Path = Path()) -> BodySchema:
    """Load a shipped body by name, or a user's by path, relative to the folder `beside`.

    Raises:
        InputError: as in `load_definition`.
    """
    path = _locate(name, "bodies", "body", beside)
    return validate(BodySchema, read_toml(path), path.name if path.parent.parent == definitions_folder() else str(path))


def _locate(name: str, folder: str, kind: str, beside: Path) -> Path:
    shipped = definitions_folder() / folder / f"{name}.toml"
    if shipped.is_file():
        return shipped
    if name.endswith(".toml") or (beside / name).exists():
        return beside / name
    raise InputError(f"{kind} '{name}' does not exist; {nearest(name, definition_names(folder))} (or give the path of a .toml file)")


class _Collector:
    """Reads the terms of one file and collects all faults, so that a user sees them together."""

    def __init__(self, subject: str, folder: Path, body_text: str | None = None):
        self.subject, self.folder, self.body_text = subject, folder, body_text
        self.sentences: list[str] = []

    def placement(self, table: Any) -> tuple[str, Any]:
        """Return how a state places the body, and the body's table without this key."""
        if not isinstance(table, dict) or "placement" not in table:
            return PLACEMENTS[0], table
        body_table = {key: value for key, value in table.items() if key != "placement"}
        if table["placement"] not in PLACEMENTS:
            setting, expected = f"{self.subject}: body.placement", " or ".join(f'"{name}"' for name in PLACEMENTS)
            remedy = nearest(str(table["placement"]), PLACEMENTS)
            self.sentences.append(str(input_error(setting, repr(table["placement"]), expected, remedy)))
        return str(table["placement"]), body_table

    def body(self, table: Any) -> tuple[str, str, BodySchema | None]:
        """Return the body's name, the text of its file, and the body. A body that is written out in the model has no separate text."""
        if not isinstance(table, dict):
            return "", "", None
        if "name" not in table:
            return "written out in the model", "", self.attempt(lambda: validate(BodySchema, table, f"{self.subject}: body"))
        name = table["name"]
        for key in table:
            if key != "name":
                self.sentences.append(f"{self.subject}: body.{key}: unknown key beside a body's name; {nearest(key, ['name'])}")
        if not isinstance(name, str):
            self.sentences.append(str(input_error(f"{self.subject}: body.name", str(name), "a string", "put the name of a body in double quotes")))
            return "", "", None
        if self.body_text is not None:
            return name, self.body_text, self._parsed_body(name, self.body_text)
        body = self.attempt(lambda: load_body(name, self.folder), f"{self.subject}: body.name: ")
        text = _locate(name, "bodies", "body", self.folder).read_text(encoding="utf-8-sig") if body else ""
        return name, text, body

    def _parsed_body(self, name: str, text: str) -> BodySchema | None:
        subject = f"{self.subject}: the body '{name}'"
        return self.attempt(lambda: validate(BodySchema, parse_toml(text, subject), subject))

    def term(self, room: Room, place: str, table: TermTable) -> TermDefinition:
        """Return a term with its options, validated by the schema registered for its kind."""
        return TermDefinition(table.kind, self._options(room, place, table.kind, table.options))

    def likelihood(self, index: int, table: TermTable) -> LikelihoodDefinition:
        """Return a likelihood. Its sub-table `observation` belongs to the observation of the same kind."""
        place, options = f"likelihood #{index + 1}", table.options
        observation = options.pop("observation", {})
        read = self._options("likelihood", place, table.kind, options)
        # A kind that does not exist is reported only once.
        is_registered = table.kind in names("likelihood")
        prepared = self._options("observation", f"{place}.observation", table.kind, observation) if is_registered else None
        return LikelihoodDefinition(table.kind, read, prepared)

    def repeated(self, key: str, kinds: list[str]) -> None:
        """Report a kind that stands in two tables, where there may be one of each."""
        for kind in dict.fromkeys(kind for kind in kinds if kinds.count(kind) > 1):
            remedy = "put its options in one table"
            self.sentences.append(str(input_error(f"{self.subject}: {key}", f"two tables of the kind '{kind}'", "one of each kind", remedy)))

    def detectors(self, table: Any, placement: str) -> None:
        """Report detectors of the parts of a body that is placed by angles. The schema of the file reports other faults."""
        if table is not None and placement != "parts":
            problem, remedy = "the body is placed by angles, and detections propose places of its parts", "leave the table out"
            self.sentences.append(str(input_error(f"{self.subject}: detectors", problem, 'placement = "parts" under [body]', remedy)))

    def _options(self, room: Room, place: str, kind: str, options: Any) -> Any:
        term = self.attempt(lambda: find(room, kind), f"{self.subject}: {place}.kind: ")
        return self.attempt(lambda: validate(term.options, options, f"{self.subject}: {place}")) if term else None

    def attempt[Result](self, action: Callable[[], Result], prefix: str = "") -> Result | None:
        """Return the action's result. If an input is wrong, collect its sentences and return None."""
        try:
            return action()
        except FaultyFileError as error:
            self.sentences += error.sentences
        except InputError as error:
            self.sentences.append(f"{prefix}{error}")
        return None
