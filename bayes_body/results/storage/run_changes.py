"""What the numbers of a run depend on: its id, its plugins, and the changes that forbid continuing it.

The texts of the plugins are stored for comparison and for people to read. They are never executed from there.
"""

import ast
import hashlib
import json
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from bayes_body.base.errors import input_error
from bayes_body.base.toml.read import parse_toml
from bayes_body.model.definition import FORMER_NAMES
from bayes_body.model.plugins.load import loaded
from bayes_body.recording.session.read import FILE_NAME
from bayes_body.results.storage.names import RUN_FILE


def kept_plugins(record: Mapping[str, Any]) -> dict[str, str]:
    """Return the texts of the plugins with which a run was made, by file name; empty if it used none."""
    return dict(record.get("plugins", {}))


def check_plugins(folder: Path, stored_texts: Mapping[str, str]) -> None:
    """Check that the plugins of a run are loaded; the stored text is never executed.

    Raises:
        InputError: a plugin is not loaded, or it has changed since the run was made.
    """
    loaded_texts = {plugin.path.name: plugin.text for plugin in loaded()}
    subject = f"{folder / RUN_FILE}: plugins"
    for name, text in stored_texts.items():
        if name not in loaded_texts:
            raise input_error(
                subject, f"the run has terms of {name}, which is not loaded", "the run's plugins", f"give that file with --plugin {name}"
            )
        if meaning(loaded_texts[name]) != meaning(text):
            remedy = f"put it back: its text is in {RUN_FILE}, under [plugins]; or start a new run in another folder"
            raise input_error(subject, f"{name} changed since the run was made", "the file that the run was made with", remedy)


def meaning(code: str) -> str:
    """Return a digest of Python code; comments and layout do not matter."""
    try:
        said = ast.dump(ast.parse(code))
    except (SyntaxError, ValueError, RecursionError, MemoryError):
        # The parser refuses deep nesting with the last two.
        said = code
    return hashlib.sha256(said.encode()).hexdigest()[:12]


# Packages that determine the numbers of a run: another version of one of them may give other numbers. The last three decode images and prepare them.
COMPUTING = ("bayes-body", "jax", "jaxlib", "numpyro", "blackjax", "opencv-python-headless", "av", "numpy")
# Number of changes that one sentence names.
NAMED = 4
# Before the name of an input.
RECORDING = "recording: "
# What a file says of itself: no number depends on it.
DESCRIPTIONS = {f"{file}: {key}" for file in ("the model's file", "the body's file") for key in ("title", "source")}
# What changes in a session while it is recorded.
GROWING = (f"{FILE_NAME}: frames", f"{FILE_NAME}: recorded")
# In what the runs of one session differ that are put together as chains: their randomness, and how many filters each has.
BY_CHAIN = ("--seed", "--runs", "smoothing.seed", "smoothing.folder", "smoothing.run", "smoothing.last")
# What a session says of itself: no evidence depends on it. And what else makes two evidences those of different data, or of different arithmetic.
UNREAD, OF_DATA = (f"{FILE_NAME}: title",), ("--first-frame", "the precision", "the version of bayes-body")
# Digits of a run's id.
DIGITS = 16


def run_id(record: Mapping[str, Mapping[str, Any]]) -> str:
    """Return the id of a run: a digest of everything on which its numbers depend, the first pose included. Its number of frames may change."""
    # 60 and 60.0 are the same number.
    values: dict[str, Any] = {key: float(value) if type(value) is int else value for key, value in _comparable(record).items()}
    values["first_pose"] = record.get("first_pose")
    return hashlib.sha256(json.dumps(values, sort_keys=True, default=str).encode()).hexdigest()[:DIGITS]


def refuse_changes(folder: Path, stored_record: Mapping[str, Mapping[str, Any]], record: Mapping[str, Mapping[str, Any]]) -> None:
    """Check that a run can be continued: everything on which its numbers depend must be unchanged. The number of frames may change.

    Raises:
        InputError: something has changed; the sentence names it with the old and the new value.
    """
    stored_values, new_values = _comparable(stored_record), _comparable(record)
    changed = [_describe_change(key, stored_values, new_values) for key in _changed(stored_values, new_values)]
    if changed:
        remedy = "change it back, or start a new run in another folder with --out"
        raise input_error(f"{folder}: cannot be continued", _listed(changed), "the settings with which the run started", remedy)


def refuse_strangers(folders: Sequence[Path], records: Sequence[Mapping[str, Mapping[str, Any]]]) -> None:
    """Check that runs are independent runs of one session with the same model and options, which differ in their seeds only.

    Args:
        folders: the folders of the runs.
        records: their tables.

    Raises:
        InputError: a run differs in more; the sentence names the folder, the value there and that of the first run.
    """
    values = [{key: value for key, value in _comparable(record).items() if key not in BY_CHAIN} for record in records]
    expected, remedy = "the same session, model and options in all runs, only other seeds", "leave it out, or make it again like the first run"
    for folder, of_run in zip(folders[1:], values[1:], strict=True):
        differences = _differences(of_run, values[0])
        if differences:
            raise input_error(f"{folder}: does not belong to {folders[0]}", _listed(differences), expected, remedy)


def refuse_other_data(folders: Sequence[Path], records: Sequence[Mapping[str, Mapping[str, Any]]]) -> None:
    """Check that runs are of the same images and cameras, from the same frame on; models, kernels and seeds may differ.

    Args:
        folders: the folders of the runs.
        records: their tables.

    Raises:
        InputError: a run is of other data; the sentence names the folder, the value there and that of the first run.
    """
    values = [{key: value for key, value in _comparable(record).items() if _is_of_data(key)} for record in records]
    expected, remedy = "the same recording in all runs: evidence is that of its images", "leave one out, or track the other recording"
    for folder, of_run in zip(folders[1:], values[1:], strict=True):
        differences = _differences(of_run, values[0])
        if differences:
            raise input_error(f"{folder}: cannot be compared with {folders[0]}", _listed(differences), expected, remedy)


def model_settings(record: Mapping[str, Mapping[str, Any]]) -> str:
    """Return a text that is equal for runs that differ in their seeds, their number of filters and the number of stored draws only."""
    values = {key: value for key, value in _comparable(record).items() if key not in (*BY_CHAIN, "--keep", *DESCRIPTIONS)}
    return json.dumps({key: value for key, value in values.items() if not key.startswith("chains.")}, sort_keys=True, default=str)


def _is_of_data(key: str) -> bool:
    return key in OF_DATA or (key.startswith((f"{FILE_NAME}: ", RECORDING)) and key not in UNREAD)


def _differences(of_run: Mapping[str, Any], first: Mapping[str, Any]) -> list[str]:
    return [f"{key.removeprefix(RECORDING)} is {_shown(of_run, key)}, and {_shown(first, key)} in the first run" for key in _changed(first, of_run)]


def _changed(stored_values: Mapping[str, Any], new_values: Mapping[str, Any]) -> list[str]:
    """Return the names of the values that differ, without those on which no number depends."""
    return [key for key in dict.fromkeys([*stored_values, *new_values]) if stored_values.get(key) != new_values.get(key) and key not in DESCRIPTIONS]


def _listed(changes: Sequence[str]) -> str:
    """Return the first changes, and the number of the others."""
    more = [f"{len(changes) - NAMED} more differ"] if len(changes) > NAMED else []
    return "; ".join([*changes[:NAMED], *more])


def _comparable(record: Mapping[str, Mapping[str, Any]]) -> dict[str, Any]:
    """Return all values on which the numbers depend, by names that a user knows; comments and layout of the texts do not matter."""
    run, definition = record["run"], record["definition"]
    model = Path(str(run.get("model"))).stem
    # A run keeps its id when its model gets another name.
    named = {"--model": FORMER_NAMES.get(model, model), "--runs": run.get("runs"), "--seed": run.get("seed"), "--init": run.get("init", "given")}
    named |= {"--recover": run.get("recover", False)}
    named |= {"--first-frame": run["first_frame"]} if "first_frame" in run else {}
    # Runs of all particles have no such setting.
    named |= {"--keep": f"draws={run['keep']}"} if run.get("keep") else {}
    named |= {f"kernel.{key}": value for key, value in _leaves(record["kernel"])}
    named |= {f"smoothing.{key}": value for key, value in _leaves(record.get("smoothing") or {})}
    chains = {name: values for name, values in (record.get("chains") or {}).items() if name != "folders"}
    named |= {f"chains.{key}": value for key, value in _leaves(chains)}
    named |= {"the precision": record.get("machine", {}).get("precision")}
    named |= {f"the version of {package}": record["versions"].get(package) for package in COMPUTING}
    named |= {f"the plugin {name}": meaning(text) for name, text in kept_plugins(record).items()}
    texts = {"the model's file": definition.get("text", ""), "the body's file": definition.get("body_text", ""), FILE_NAME: record["session"]["text"]}
    named |= {f"{title}: {key}": value for title, text in texts.items() for key, value in _leaves(parse_toml(text, title))}
    if run.get("live"):
        # The recording grows during such a run.
        return {key: value for key, value in named.items() if key not in GROWING and not key.startswith(tuple(f"{key}." for key in GROWING))}
    return named | {f"{RECORDING}{name}": digest for name, digest in record.get("inputs", {}).items()}


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


def _describe_change(key: str, stored_values: Mapping[str, Any], new_values: Mapping[str, Any]) -> str:
    if key.startswith(RECORDING):
        return f"the recording has changed ({key.removeprefix(RECORDING)})"
    return f"{key} was {_shown(stored_values, key)} and is now {_shown(new_values, key)}"


def _shown(values: Mapping[str, Any], key: str) -> str:
    return str(values[key]) if key in values else "not set"
