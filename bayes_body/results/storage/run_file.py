"""`run.toml` and its schema. The file has everything that is needed to repeat or continue a run.

It contains the settings, every option of the kernel, the versions, digests of the recording, and the texts of model and session. The table `[check]`
has the id of the run and a digest of all other tables, so that a change by hand is noticed.

The schema does not check the kernel's options and the texts; they are checked where they are used.
"""

import hashlib
import json
import platform
from collections.abc import Mapping
from importlib.metadata import version
from pathlib import Path
from typing import Annotated, Any, Literal

import jax
import tomlkit
from pydantic import ConfigDict, Field

from bayes_body.base.errors import escaped, input_error
from bayes_body.base.files.atomic import write_text
from bayes_body.base.registry import Place, Room
from bayes_body.base.toml.read import parse_toml, read_toml, validate
from bayes_body.base.toml.schema import Count, Schema
from bayes_body.model.definition import Definition, current_name, definition_names
from bayes_body.model.plugins.load import providing
from bayes_body.recording.session.read import FILE_NAME
from bayes_body.results.storage.names import RESULTS, RUN_FILE
from bayes_body.results.storage.run_changes import COMPUTING, check_plugins, kept_plugins, run_id

Text = Annotated[str, Field(strict=True)]
# Keys of older and newer versions are kept.
OPEN = ConfigDict(extra="allow", frozen=True)


class RunTable(Schema):
    """`[run]`: the settings of the user."""

    session: Text
    model: Text
    runs: Count = 1
    seed: Annotated[int, Field(strict=True, ge=0)] = 0
    first_frame: Annotated[int, Field(strict=True, ge=0)] | None = None
    frames: Count | None = None
    init: Literal["given", "auto"] = "given"
    recover: Annotated[bool, Field(strict=True)] = False
    keep: Count | None = None
    # Whether frames came while the session was recorded.
    live: Annotated[bool, Field(strict=True)] = False


class KernelTable(Schema):
    """`[kernel]`: its kind, and all its options."""

    model_config = OPEN
    kind: Text


class SmoothingTable(Schema):
    """`[smoothing]` of a smoothed run: the run whose frames were smoothed, and the options of the smoother. Joint paths do not move."""

    folder: Text
    run: Text
    last: Text
    frames: Count
    seed: Annotated[int, Field(strict=True, ge=0)]
    draws: Count
    start: Literal["ensemble", "particles", "gaussian", "joint"]
    moves: Annotated[int, Field(strict=True, ge=0)] | None = None
    leapfrog_steps: Count | None = None
    candidates: Count | None = None


class ChainsTable(Schema):
    """`[chains]` of runs that were put together: the folder, id, seed and last frame's digest of each of them, and their number of frames."""

    folders: list[Text]
    runs: list[Text]
    seeds: list[Annotated[int, Field(strict=True, ge=0)]]
    last: list[Text]
    frames: Count


class DefinitionTable(Schema):
    """`[definition]`: the text of the definition and of its body."""

    title: Text = ""
    text: Text
    body_text: Text | None = None


class SessionText(Schema):
    """`[session]`: the text of session.toml."""

    text: Text


class CheckTable(Schema):
    """`[check]`: the version of the format, the id of the run, and a digest of all other tables."""

    format: Annotated[int, Field(strict=True)]
    run: Text
    sha256: Text


class RunFile(Schema):
    """The whole file."""

    run: RunTable
    kernel: KernelTable
    versions: dict[str, Text]
    machine: dict[str, Any] = {}
    inputs: dict[str, Text] = {}
    definition: DefinitionTable
    session: SessionText
    plugins: dict[str, Text] = {}
    first_pose: dict[str, Any] = {}
    smoothing: SmoothingTable | None = None
    chains: ChainsTable | None = None
    check: CheckTable


PACKAGES = (*COMPUTING, "arviz")
# The version of the format of run.toml and of the frames.
FORMAT = 2
# Characters of a strange version that a sentence shows.
SHOWN = 16
AGAIN = "make the run again with `bayes-body track`"
HEADING = "Made by bayes-body track. The same settings with the same versions on the same kind of processor repeat the run."


def describe(
    session: Path,
    model: str,
    definition: Definition,
    kind: str,
    options: Mapping[str, Any],
    settings: Mapping[str, Any],
    inputs: Mapping[str, str] | None = None,
) -> dict[str, dict[str, Any]]:
    """Return the tables of `run.toml`.

    Args:
        session: folder of the session, or its file.
        model: the definition's name or path.
        definition: the definition itself.
        kind: the kernel's name.
        options: all options of the kernel.
        settings: the other settings of the run by name, such as its seed; None for one that is not set.
        inputs: digests of the recording's files, from `input_digests`.
    """
    # A path is stored as an absolute path, so that the run can be continued from another folder.
    model = current_name(model) if current_name(model) in definition_names() else str(Path(model).resolve())
    file = session.resolve() / FILE_NAME if session.is_dir() else session.resolve()
    settings = {"session": str(file.parent), "model": model, **settings}
    texts = {"title": definition.title, "text": definition.text, "body_text": definition.body_text or None}
    plugins = {plugin.path.name: plugin.text for plugin in providing(places_of(definition, kind))}
    return {
        "run": _without_none(settings),
        "kernel": _without_none({"kind": kind, **options}),
        **computing_here(),
        "inputs": dict(inputs or {}),
        "definition": _without_none(texts),
        "session": {"text": file.read_text(encoding="utf-8-sig")},
        **({"plugins": plugins} if plugins else {}),
    }


def computing_here() -> dict[str, dict[str, Any]]:
    """Return the tables `versions` and `machine` of this process."""
    return {
        "versions": {"python": platform.python_version(), **{package: version(package) for package in PACKAGES}},
        "machine": {"platform": platform.platform(), "devices": [str(device) for device in jax.devices()], "precision": _precision()},
    }


def _precision() -> str:
    return "float64" if jax.config.jax_enable_x64 else "float32"


def places_of(definition: Definition, kernel: str) -> set[Place]:
    """Return the terms that a run with this definition and kernel uses."""
    constraints: list[Place] = [("potential", term.kind) for term in definition.constraints]
    rooms: tuple[Room, ...] = ("likelihood", "observation")
    likelihoods: list[Place] = [(room, term.kind) for term in definition.likelihoods for room in rooms]
    unknowns: list[Place] = [("unknown", term.kind) for term in definition.unknowns]
    return {("dynamics", definition.dynamics.kind), ("kernel", kernel), *constraints, *likelihoods, *unknowns}


def _without_none(table: Mapping[str, Any]) -> dict[str, Any]:
    """Return the table without values of None, since TOML has no null."""
    return {key: value for key, value in table.items() if value is not None}


def write_run_file(folder: Path, record: Mapping[str, Mapping[str, Any]]) -> str:
    """Write `run.toml`, either completely or not at all. Return the id of the run.

    Raises:
        InputError: the file system does not accept it.
    """
    document = tomlkit.document()
    document.add(tomlkit.comment(HEADING))
    for name, table in record.items():
        if name != "check":
            document[name] = {key: tomlkit.string(value, multiline=True) if _is_text(name, key) else value for key, value in table.items()}
    # The digests are of what a reader finds.
    tables = parse_toml(tomlkit.dumps(document), RUN_FILE)
    check = {"format": FORMAT, "run": run_id(tables)}
    document["check"] = check | {"sha256": _seal(tables | {"check": check})}
    write_text(folder / RUN_FILE, tomlkit.dumps(document))
    return str(check["run"])


def _is_text(table: str, key: str) -> bool:
    return table == "plugins" or "text" in key


def read_run_file(folder: Path) -> dict[str, dict[str, Any]]:
    """Return the tables of a run's `run.toml`.

    Raises:
        InputError: the file is missing, not valid TOML, of another version, or was changed by hand; or a plugin of the run was not loaded.
        FaultyFileError: the file has faults; one sentence for each.
    """
    record = read_record(folder)
    check_plugins(folder, kept_plugins(record))
    return record


def read_record(folder: Path) -> dict[str, dict[str, Any]]:
    """Return the tables as `read_run_file` does, with its errors, without a look at the plugins."""
    path = folder / RUN_FILE
    record = read_toml(path)
    check = record.get("check")
    if not isinstance(check, dict) or check.get("format") != FORMAT:
        version = check.get("format", "none") if isinstance(check, dict) else "none"
        raise input_error(path, f"format {escaped(str(version)[:SHOWN])}: written by another version", f"format {FORMAT}", AGAIN)
    validate(RunFile, record, str(path))
    if check["sha256"] != _seal(record):
        problem = "was changed since it was written (its digest is another)"
        raise input_error(path, problem, "the settings that the run wrote", f"restore it, or {AGAIN}")
    return record


def _seal(record: Mapping[str, Any]) -> str:
    """Return a digest of all tables except `[check]`, and of the run's id."""
    tables = {name: table for name, table in record.items() if name != "check"} | {"id": record["check"]["run"]}
    return hashlib.sha256(json.dumps(tables, sort_keys=True, default=str).encode()).hexdigest()


def refuse_links(folder: Path) -> None:
    """Check that the files of a run are in its folder themselves: a link in a stranger's folder leads anywhere.

    Raises:
        InputError: one of them is a link.
    """
    for name in (RUN_FILE, *RESULTS):
        if (folder / name).is_symlink():
            raise input_error(folder / name, "a link to elsewhere", "a file or folder of the run itself", "put the file itself there")
