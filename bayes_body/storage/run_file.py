"""`run.toml`, which has everything that is needed to repeat or continue a run.

It contains the settings, every option of the kernel, the versions, and the texts of model and session. The texts of plugins are stored for comparison
and for people to read. They are never executed from there.
"""

import ast
import hashlib
import platform
from collections.abc import Iterator, Mapping
from importlib.metadata import version
from pathlib import Path
from typing import Any

import jax
import tomlkit

from bayes_body.errors import input_error
from bayes_body.files.atomic import write_text
from bayes_body.model.definition import Definition, definition_names
from bayes_body.plugins.load import loaded, providing
from bayes_body.registry import Place, Room
from bayes_body.session.read import FILE_NAME
from bayes_body.storage.names import RUN_FILE
from bayes_body.toml.read import parse_toml, read_toml

# Packages that determine the numbers of a run: another version of one of them may give other numbers.
COMPUTING = ("bayes-body", "jax", "jaxlib", "numpyro", "blackjax")
PACKAGES = (*COMPUTING, "arviz", "opencv-python-headless", "numpy")
HEADING = "Made by bayes-body track. The same settings with the same versions on the same kind of processor repeat the run."
# Number of changes that one sentence names.
NAMED = 4
TABLES = ("run", "kernel", "versions", "definition", "session")


def describe(
    session: Path, model: str, definition: Definition, kind: str, options: Mapping[str, Any], settings: Mapping[str, Any]
) -> dict[str, dict[str, Any]]:
    """Return the tables of `run.toml`.

    Args:
        session: folder of the session, or its file.
        model: the definition's name or path.
        definition: the definition itself.
        kind: the kernel's name.
        options: all options of the kernel.
        settings: the other settings of the run by name, such as its seed; None for one that is not set.
    """
    # A path is stored as an absolute path, so that the run can be continued from another folder.
    model = model if model in definition_names() else str(Path(model).resolve())
    file = session.resolve() / FILE_NAME if session.is_dir() else session.resolve()
    settings = {"session": str(file.parent), "model": model, **settings}
    texts = {"title": definition.title, "text": definition.text, "body_text": definition.body_text or None}
    plugins = {plugin.path.name: plugin.text for plugin in providing(places_of(definition, kind))}
    return {
        "run": _known(settings),
        "kernel": _known({"kind": kind, **options}),
        "versions": {"python": platform.python_version(), **{package: version(package) for package in PACKAGES}},
        "machine": {"platform": platform.platform(), "devices": [str(device) for device in jax.devices()]},
        "definition": _known(texts),
        "session": {"text": file.read_text(encoding="utf-8-sig")},
        **({"plugins": plugins} if plugins else {}),
    }


def places_of(definition: Definition, kernel: str) -> set[Place]:
    """Return the terms that a run with this definition and kernel uses."""
    constraints: list[Place] = [("potential", term.kind) for term in definition.constraints]
    rooms: tuple[Room, ...] = ("likelihood", "observation")
    likelihoods: list[Place] = [(room, term.kind) for term in definition.likelihoods for room in rooms]
    return {("dynamics", definition.dynamics.kind), ("kernel", kernel), *constraints, *likelihoods}


def _known(table: Mapping[str, Any]) -> dict[str, Any]:
    """Return the table without values of None, since TOML has no null."""
    return {key: value for key, value in table.items() if value is not None}


def write_run_file(folder: Path, record: Mapping[str, Mapping[str, Any]]) -> None:
    """Write `run.toml`, either completely or not at all.

    Raises:
        InputError: the file system does not accept it.
    """
    document = tomlkit.document()
    document.add(tomlkit.comment(HEADING))
    for name, table in record.items():
        document[name] = {key: tomlkit.string(value, multiline=True) if _is_text(name, key) else value for key, value in table.items()}
    write_text(folder / RUN_FILE, tomlkit.dumps(document))


def _is_text(table: str, key: str) -> bool:
    return table == "plugins" or "text" in key


def read_run_file(folder: Path) -> dict[str, dict[str, Any]]:
    """Return the tables of a run's `run.toml`.

    Raises:
        InputError: the file is missing or not valid TOML, a table is missing, or a plugin of the run was not loaded.
    """
    record = read_toml(folder / RUN_FILE)
    missing = [name for name in TABLES if not isinstance(record.get(name), dict)]
    if missing:
        raise input_error(folder / RUN_FILE, f"no table [{missing[0]}]", "the settings of a run", "start a new run in another folder with --out")
    check_plugins(folder, kept_plugins(record))
    return record


def kept_plugins(record: Mapping[str, Any]) -> dict[str, str]:
    """Return the texts of the plugins with which a run was made, by file name; empty if it used none."""
    table = record.get("plugins")
    return {str(name): str(text) for name, text in table.items()} if isinstance(table, dict) else {}


def check_plugins(folder: Path, kept: Mapping[str, str]) -> None:
    """Check that the plugins of a run are loaded; the stored text is never executed.

    Raises:
        InputError: a plugin is not loaded, or it has changed since the run was made.
    """
    now = {plugin.path.name: plugin.text for plugin in loaded()}
    where = f"{folder / RUN_FILE}: plugins"
    for name, text in kept.items():
        if name not in now:
            raise input_error(where, f"the run has terms of {name}, which is not loaded", "the run's plugins", f"give that file with --plugin {name}")
        if _meaning(now[name]) != _meaning(text):
            remedy = f"put it back: its text is in {RUN_FILE}, under [plugins]; or start a new run in another folder"
            raise input_error(where, f"{name} changed since the run was made", "the file that the run was made with", remedy)


def _meaning(code: str) -> str:
    """Return a digest of Python code; comments and layout do not matter."""
    try:
        said = ast.dump(ast.parse(code))
    except (SyntaxError, ValueError):
        said = code
    return hashlib.sha256(said.encode()).hexdigest()[:12]


def refuse_changes(folder: Path, kept: Mapping[str, Mapping[str, Any]], now: Mapping[str, Mapping[str, Any]]) -> None:
    """Check that a run can be continued: everything on which its numbers depend must be unchanged. The number of frames may change.

    Raises:
        InputError: something has changed; the sentence names it with the old and the new value.
    """
    before, after = _comparable(kept), _comparable(now)
    changed = [key for key in dict.fromkeys([*before, *after]) if before.get(key) != after.get(key)]
    if not changed:
        return
    named = [f"{key} was {_shown(before, key)} and is now {_shown(after, key)}" for key in changed[:NAMED]]
    more = [f"{len(changed) - NAMED} more differ"] if len(changed) > NAMED else []
    remedy = "change it back, or start a new run in another folder with --out"
    raise input_error(f"{folder}: cannot be continued", "; ".join([*named, *more]), "the settings with which the run started", remedy)


def _comparable(record: Mapping[str, Mapping[str, Any]]) -> dict[str, Any]:
    """Return all values on which the numbers depend, by names that a user knows; comments and layout of the texts do not matter."""
    run, definition = record["run"], record["definition"]
    named = {"--model": Path(str(run.get("model"))).stem, "--runs": run.get("runs"), "--seed": run.get("seed"), "--init": run.get("init", "given")}
    named |= {"--recover": run.get("recover", False)}
    named |= {f"kernel.{key}": value for key, value in _leaves(record["kernel"])}
    named |= {f"the version of {package}": record["versions"].get(package) for package in COMPUTING}
    named |= {f"the plugin {name}": _meaning(text) for name, text in kept_plugins(record).items()}
    texts = {"the model's file": definition.get("text", ""), "the body's file": definition.get("body_text", ""), FILE_NAME: record["session"]["text"]}
    return named | {f"{title}: {key}": value for title, text in texts.items() for key, value in _leaves(parse_toml(text, title))}


def _leaves(value: Any, path: str = "") -> Iterator[tuple[str, Any]]:
    """Yield every number and text of a table, with its path; entries of lists are counted from 1."""
    if isinstance(value, Mapping):
        entries = [(str(key), entry) for key, entry in value.items()]
    elif isinstance(value, list | tuple):
        entries = [(str(number), entry) for number, entry in enumerate(value, 1)]
    else:
        yield path, value
        return
    for key, entry in entries:
        yield from _leaves(entry, f"{path}.{key}" if path else key)


def _shown(values: Mapping[str, Any], key: str) -> str:
    return str(values[key]) if key in values else "not set"
