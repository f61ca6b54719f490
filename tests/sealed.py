"""A run's folder sealed again after a change, as somebody would do who wants the change to go unnoticed."""

import tomllib
from pathlib import Path

import tomlkit

from bayes_body.results.storage.manifest import MadeOf, Manifest
from bayes_body.results.storage.names import POSTERIOR_FILE, RUN_FILE, SUMMARY_FILE
from bayes_body.results.storage.run_file import FORMAT, _seal


def seal(folder: Path, frames: int = 5) -> None:
    """Write the digests of what the folder has now."""
    path = folder / RUN_FILE
    tables = {name: table for name, table in tomllib.loads(path.read_text(encoding="utf-8")).items() if name != "check"}
    check = {"format": FORMAT, "run": "0123456789abcdef"}
    tables["check"] = check | {"sha256": _seal(tables | {"check": check})}
    path.write_text(tomlkit.dumps(tables), encoding="utf-8")
    manifest = Manifest(run=check["run"])
    for name in (POSTERIOR_FILE, SUMMARY_FILE):
        manifest = manifest.with_result(folder, name, MadeOf(frames, "last")) if (folder / name).exists() else manifest
    manifest.write(folder)
