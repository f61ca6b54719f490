"""The plugins of a run: their texts are stored for comparison and for people to read. They are never executed from there."""

import ast
import hashlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from bayes_body.base.errors import input_error
from bayes_body.model.plugins.load import loaded
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
    where = f"{folder / RUN_FILE}: plugins"
    for name, text in stored_texts.items():
        if name not in loaded_texts:
            raise input_error(where, f"the run has terms of {name}, which is not loaded", "the run's plugins", f"give that file with --plugin {name}")
        if meaning(loaded_texts[name]) != meaning(text):
            remedy = f"put it back: its text is in {RUN_FILE}, under [plugins]; or start a new run in another folder"
            raise input_error(where, f"{name} changed since the run was made", "the file that the run was made with", remedy)


def meaning(code: str) -> str:
    """Return a digest of Python code; comments and layout do not matter."""
    try:
        said = ast.dump(ast.parse(code))
    except (SyntaxError, ValueError, RecursionError, MemoryError):
        # The parser refuses deep nesting with the last two.
        said = code
    return hashlib.sha256(said.encode()).hexdigest()[:12]
