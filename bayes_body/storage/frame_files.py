"""Frames on disk, one file each: `000057.npz` is complete or missing, and a stored frame is not computed again.

A file has the arrays of a `FrameResult` and no Python objects: `states.NAME`, `log_weights`, `info.FIELD`, `markov.NAME`, `messages.NAME`,
`seen`, `seconds`, `seconds_ready`, `restarted`.
"""

from collections.abc import Iterator, Mapping
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bayes_body.density.kernel import FilterInfo
from bayes_body.errors import InputError, input_error
from bayes_body.files.atomic import make_folder, remove_partial, replacing
from bayes_body.tracking.draws import FrameResult

# Fields of a kernel's diagnostics that are mappings; a frame written by an older version lacks `messages`.
MAPPINGS = ("markov", "messages")
# Readers go through the frames in order, and look back one frame.
KEPT_IN_MEMORY = 2


class FrameFiles:
    """The frames of a folder, from the first one up to the first that is missing; each is read on demand.

    Args:
        folder: the folder of the files; it is made when the first frame is stored.
    """

    def __init__(self, folder: Path):
        self.folder = folder
        self._count = _count_files(folder)
        self._read = lru_cache(KEPT_IN_MEMORY)(lambda index: load_frame(self.path(index)))

    def path(self, index: int) -> Path:
        """Return the file of a frame."""
        return self.folder / f"{index:06d}.npz"

    def __len__(self) -> int:
        return self._count

    def __getitem__(self, index: int, /) -> FrameResult:
        """Return frame `index`, counted from the end if negative.

        Raises:
            IndexError: there is no such frame.
            InputError: its file is damaged.
        """
        if not -self._count <= index < self._count:
            raise IndexError(index)
        return self._read(index % self._count)

    def __iter__(self) -> Iterator[FrameResult]:
        return (self[index] for index in range(self._count))

    def append(self, result: FrameResult, /) -> None:
        """Store the next frame. It is on the disk when this function returns.

        Raises:
            InputError: the file system does not accept it.
        """
        if not self._count:
            make_folder(self.folder)
        save_frame(self.path(self._count), result)
        self._read.cache_clear()
        self._count += 1

    def mend(self) -> str:
        """Prepare to continue: remove half-written files, read all frames, and end before the first damaged one.

        Returns:
            A sentence about the damage; empty if all frames are complete. Files after the damaged one stay until their frames are stored again.
        """
        remove_partial(self.folder)
        for index in range(self._count):
            try:
                load_frame(self.path(index))
            except InputError as damage:
                self._count = index
                return str(damage)
        return ""


def _count_files(folder: Path) -> int:
    names = {path.name for path in folder.glob("*.npz")}
    count = 0
    while f"{count:06d}.npz" in names:
        count += 1
    return count


def save_frame(path: Path, result: FrameResult) -> None:
    """Write one frame, either completely or not at all.

    Raises:
        InputError: the file system does not accept it.
    """
    arrays: dict[str, Any] = {f"states.{name}": values for name, values in result.states.items()}
    arrays |= {f"info.{name}": values for name, values in result.info._asdict().items() if name not in MAPPINGS}
    for mapping in MAPPINGS:
        arrays |= {f"{mapping}.{name}": values for name, values in getattr(result.info, mapping).items()}
    arrays |= {name: getattr(result, name) for name in ("log_weights", "seen", "seconds", "seconds_ready", "restarted")}
    with replacing(path) as partial, partial.open("wb") as file:
        np.savez(file, allow_pickle=False, **arrays)


def load_frame(path: Path) -> FrameResult:
    """Read one frame, and verify the checksums of its arrays.

    Raises:
        InputError: the file is missing, truncated or damaged.
    """
    try:
        with np.load(path, allow_pickle=False) as file:
            return _frame(dict(file))
    except Exception as error:
        # A damaged archive can raise anything: zlib.error, struct.error, KeyError, NotImplementedError, ...
        found = f"cannot be read ({str(error).splitlines()[0] if str(error) else type(error).__name__})"
        raise input_error(path, found, "a frame written by `bayes-body track`", "compute it again with --resume") from None


def _frame(arrays: Mapping[str, NDArray[Any]]) -> FrameResult:
    info: dict[str, Any] = {name: arrays[f"info.{name}"] for name in FilterInfo._fields if name not in MAPPINGS}
    info |= {mapping: _under(f"{mapping}.", arrays) for mapping in MAPPINGS}
    return FrameResult(
        states=_under("states.", arrays),
        log_weights=arrays["log_weights"],
        info=FilterInfo(**info),
        seen=arrays["seen"],
        seconds=float(arrays["seconds"]),
        seconds_ready=float(arrays["seconds_ready"]),
        # A frame written by an older version lacks it.
        restarted=arrays.get("restarted", np.zeros(0, bool)),
    )


def _under(prefix: str, arrays: Mapping[str, NDArray[Any]]) -> dict[str, NDArray[Any]]:
    return {name.removeprefix(prefix): values for name, values in arrays.items() if name.startswith(prefix)}
