"""Replications on disk: one line of JSON per block, the settings in the first line. A truncated line is computed again."""

import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from bayes_body.base.errors import input_error
from bayes_body.base.files.atomic import refused

SUFFIX = ".partial"


class ReplicationLog:
    """Blocks of replications by experiment and number. With a path, a block is on disk as soon as it is added."""

    def __init__(self, path: Path | None = None, settings: Mapping[str, Any] | None = None):
        """Read the blocks of an existing file.

        Args:
            path: the file; None keeps the blocks in memory.
            settings: the settings of the replications.

        Raises:
            InputError: the file holds replications with other settings, or cannot be read or written.
        """
        self.path, self._blocks = path, {}
        if path is None:
            return
        head, blocks, size = _read(path)
        if head is not None and head != (wanted := json.loads(json.dumps(settings))):
            name = next(key for key in {**head, **wanted} if head.get(key) != wanted.get(key))
            problem, expected = f"replications with {name} = {head.get(name)!r}", f"{name} = {wanted.get(name)!r}"
            raise input_error(path, problem, expected, "use its settings, remove it, or name another file with --json")
        self._blocks = blocks
        if head is None:
            self._write(json.dumps({"settings": settings}), 0)
        elif size < path.stat().st_size:
            self._write("", size)

    def __contains__(self, key: tuple[str, int]) -> bool:
        return key in self._blocks

    def __getitem__(self, key: tuple[str, int]) -> dict[str, np.ndarray]:
        return self._blocks[key]

    def __len__(self) -> int:
        return len(self._blocks)

    def add(self, experiment: str, block: int, figures: dict[str, np.ndarray]) -> None:
        """Store a block.

        Raises:
            InputError: the file cannot be written.
        """
        self._blocks[experiment, block] = figures
        if self.path is not None:
            values = {name: {"type": value.dtype.name, "values": value.tolist()} for name, value in figures.items()}
            self._write(json.dumps({"experiment": experiment, "block": block, "figures": values}))

    def remove(self) -> None:
        """Remove the file, because its content was reported elsewhere."""
        if self.path is not None:
            self.path.unlink(missing_ok=True)

    def _write(self, line: str, size: int | None = None) -> None:
        """Append a line; if `size` is given, after the file's first `size` bytes."""
        assert self.path is not None
        try:
            with self.path.open("ab") as file:
                if size is not None:
                    file.truncate(size)
                file.write(f"{line}\n".encode() if line else b"")
                file.flush()
                os.fsync(file.fileno())
        except OSError as error:
            raise refused(self.path, "written", error) from None


def settings_of(path: Path) -> dict[str, Any] | None:
    """The settings of the replications in a file; None if there are none.

    Raises:
        InputError: the file cannot be read.
    """
    return _read(path)[0]


def _read(path: Path) -> tuple[dict[str, Any] | None, dict[tuple[str, int], dict[str, np.ndarray]], int]:
    """Settings, blocks, and the size in bytes of the complete lines that this class wrote."""
    try:
        content = path.read_bytes()
    except FileNotFoundError:
        return None, {}, 0
    except OSError as error:
        raise input_error(path, f"cannot be read ({error.strerror})", "the replications of a check", "name another file with --json") from None
    head, blocks, size = None, {}, 0
    for line in content.splitlines(keepends=True):
        try:
            entry = json.loads(line)
            if head is None:
                head = entry["settings"]
            else:
                blocks[entry["experiment"], entry["block"]] = {
                    name: np.array(value["values"], value["type"]) for name, value in entry["figures"].items()
                }
        except (ValueError, KeyError, TypeError):
            break
        if not line.endswith(b"\n"):
            break
        size += len(line)
    if head is None and content.strip():
        raise input_error(path, "its first line is not that of a check", "the replications of a check", "remove it, or name another file with --json")
    return head, blocks, size
