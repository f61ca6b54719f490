"""Frames on disk, one file each: `000057.npz` is complete or missing, and a stored frame is not computed again.

A file has the arrays of a `FrameResult` and no Python objects: `states.NAME`, `log_weights`, `info.FIELD`, `markov.NAME`, `messages.NAME`,
`seen`, `seconds`, `seconds_ready`, `restarted`; and its place: `run`, `number`, `before` and `digest`. The digest is of everything else in the file,
and `before` is the digest of the frame before it. So a frame that was changed, exchanged, copied or taken from another run is noticed.
"""

import hashlib
from collections.abc import Iterator, Mapping
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from bayes_body.density.kernel import FilterInfo
from bayes_body.errors import InputError, escaped, input_error
from bayes_body.files.arrays_file import read_arrays
from bayes_body.files.atomic import make_folder, remove_partial, replacing
from bayes_body.tracking.draws import FrameResult

# Fields of a kernel's diagnostics that are mappings.
MAPPINGS = ("markov", "messages")
# Readers go through the frames in order, and look back one frame.
KEPT_IN_MEMORY = 2
# Characters of a foreign id that a sentence shows.
SHOWN = 16
KIND, REMEDY = "a frame written by `bayes-body track`", "compute it again with --resume"


class Place(NamedTuple):
    """Where a frame belongs: the run's id, the frame's number, and the digest of the frame before it (empty for the first one)."""

    run: str
    number: int
    before: str


class Stored(NamedTuple):
    """The content of a frame's file."""

    result: FrameResult
    place: Place
    digest: str


class FrameFiles:
    """The frames of a folder, from the first one up to the first that is missing; each is read on demand.

    Args:
        folder: the folder of the files; it is made when the first frame is stored.
        run: the id of the run, which is stored with each frame. Frames with another id are refused; if it is empty, none are.
    """

    def __init__(self, folder: Path, run: str = ""):
        self.folder, self.run = folder, run
        self._count = _count_files(folder)
        # The digest of the last frame, once it is known.
        self._last: str | None = None
        self._read = lru_cache(KEPT_IN_MEMORY)(self._load)

    def path(self, index: int) -> Path:
        """Return the file of a frame."""
        return self.folder / f"{index:06d}.npz"

    def __len__(self) -> int:
        return self._count

    def __getitem__(self, index: int, /) -> FrameResult:
        """Return frame `index`, counted from the end if negative.

        Raises:
            IndexError: there is no such frame.
            InputError: its file is damaged, or belongs to another frame or run.
        """
        if not -self._count <= index < self._count:
            raise IndexError(index)
        return self._read(index % self._count).result

    def __iter__(self) -> Iterator[FrameResult]:
        return (self[index] for index in range(self._count))

    @property
    def last_digest(self) -> str:
        """The digest of the last frame, which depends on all frames before it; empty if there is none."""
        if self._last is None:
            self._last = self._read(self._count - 1).digest if self._count else ""
        return self._last

    def append(self, result: FrameResult, /) -> None:
        """Store the next frame. It is on the disk when this function returns.

        Raises:
            InputError: the file system does not accept it.
        """
        if not self._count:
            make_folder(self.folder)
        self._last = save_frame(self.path(self._count), result, Place(self.run, self._count, self.last_digest))
        self._read.cache_clear()
        self._count += 1

    def mend(self) -> str:
        """Prepare to continue: remove half-written files, read all frames, and end before the first that is damaged or in the wrong place.

        Returns:
            A sentence about the damage; empty if all frames are as they were stored. Files after the damaged one stay until their frames are stored
            again.

        Raises:
            InputError: a frame belongs to another run. It is not replaced.
        """
        remove_partial(self.folder)
        before = ""
        for index in range(self._count):
            try:
                stored = load_frame(self.path(index))
            except InputError as damage:
                return self._end_before(index, str(damage))
            self._check_run(index, stored.place)
            if (stored.place.number, stored.place.before) != (index, before):
                found = f"was stored as frame {stored.place.number} of this run, or after another frame"
                return self._end_before(index, str(input_error(self.path(index), found, f"frame {index}", REMEDY)))
            before = stored.digest
        return ""

    def _end_before(self, index: int, damage: str) -> str:
        self._count, self._last = index, None
        self._read.cache_clear()
        return damage

    def _load(self, index: int) -> Stored:
        stored = load_frame(self.path(index))
        self._check_run(index, stored.place)
        if stored.place.number != index:
            raise input_error(self.path(index), f"was stored as frame {stored.place.number}", f"frame {index}", REMEDY)
        return stored

    def _check_run(self, index: int, place: Place) -> None:
        if self.run and place.run != self.run:
            remedy = "move the file away, or start a new run in another folder with --out"
            raise input_error(
                self.path(index), f"belongs to another run ('{escaped(place.run[:SHOWN])}')", f"a frame of this run ('{self.run}')", remedy
            )


def _count_files(folder: Path) -> int:
    names = {path.name for path in folder.glob("*.npz")}
    count = 0
    while f"{count:06d}.npz" in names:
        count += 1
    return count


def save_frame(path: Path, result: FrameResult, place: Place) -> str:
    """Write one frame, either completely or not at all. Return its digest.

    Raises:
        InputError: the file system does not accept it.
    """
    arrays: dict[str, Any] = {f"states.{name}": values for name, values in result.states.items()}
    arrays |= {f"info.{name}": values for name, values in result.info._asdict().items() if name not in MAPPINGS}
    for mapping in MAPPINGS:
        arrays |= {f"{mapping}.{name}": values for name, values in getattr(result.info, mapping).items()}
    arrays |= {name: getattr(result, name) for name in ("log_weights", "seen", "seconds", "seconds_ready", "restarted")}
    arrays = {name: np.asarray(values) for name, values in (arrays | place._asdict()).items()}
    digest = _digest(arrays)
    with replacing(path) as partial, partial.open("wb") as file:
        np.savez(file, allow_pickle=False, **arrays, digest=np.asarray(digest))
    return digest


def load_frame(path: Path) -> Stored:
    """Read one frame, and verify its digest.

    Raises:
        InputError: the file is missing, truncated or damaged.
    """
    arrays = read_arrays(path, None, KIND, REMEDY)
    try:
        digest = str(arrays.pop("digest"))
        place = Place(str(arrays["run"]), int(arrays["number"]), str(arrays["before"]))
        result = _frame(arrays)
    except (KeyError, TypeError, ValueError) as error:
        raise input_error(path, f"cannot be read ({type(error).__name__}: {error})", KIND, REMEDY) from None
    if digest != _digest(arrays):
        raise input_error(path, "was changed since it was written (its digest is another)", KIND, REMEDY)
    return Stored(result, place, digest)


def _digest(arrays: Mapping[str, NDArray[Any]]) -> str:
    """Return the SHA-256 of the arrays: names, types, shapes and bytes."""
    found = hashlib.sha256()
    for name in sorted(arrays):
        values = arrays[name]
        found.update(f"{name!r} {values.dtype.str} {values.shape}\n".encode())
        found.update(values.tobytes())
    return found.hexdigest()


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
        restarted=arrays["restarted"],
    )


def _under(prefix: str, arrays: Mapping[str, NDArray[Any]]) -> dict[str, NDArray[Any]]:
    return {name.removeprefix(prefix): values for name, values in arrays.items() if name.startswith(prefix)}
