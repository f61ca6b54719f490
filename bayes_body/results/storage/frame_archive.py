"""Frames whose draws are in `posterior.nc`, so that a finished run does not hold the same numbers twice; and a frame as named arrays with a digest.

`frames/index.npz` has what the posterior lacks of each frame: its digest, its seconds, and which runs restarted. A frame that is read back is
bit-identical to the frame in a file of its own; its digest verifies this. Frames of a smoothed run are stored from the last to the first.

A frame's arrays have no Python objects. Their names are `states.NAME`, `log_weights`, `info.FIELD`, `markov.NAME`, `messages.NAME`, `modes.NAME`,
`joint.NAME`, `figures.NAME`, `seen`, `seconds`, `seconds_ready`, `restarted`; and the frame's place: `run`, `number` and `before`. The digest is of
all of them.
"""

import hashlib
from collections.abc import Mapping, Sequence
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from bayes_body.base.errors import InputError, input_error
from bayes_body.base.files.arrays_file import read_arrays
from bayes_body.base.files.atomic import replacing
from bayes_body.density.kernel import FilterInfo
from bayes_body.results.posterior.layout import frame_axis_of, place_in_tree
from bayes_body.results.storage.entries import Entries, entries_of
from bayes_body.results.storage.names import INDEX_FILE
from bayes_body.results.storage.posterior_file import check_plain
from bayes_body.tracking.draws import FrameResult

if TYPE_CHECKING:
    import h5py

# Fields of a kernel's diagnostics that are mappings.
MAPPINGS = ("markov", "messages", "modes", "joint")


class Place(NamedTuple):
    """Where a frame belongs: the run's id, the frame's number, and the digest of the frame before it (empty for the first one)."""

    run: str
    number: int
    before: str


class Stored(NamedTuple):
    """A frame that was read, where it belongs, and its digest."""

    result: FrameResult
    place: Place
    digest: str


def arrays_of(result: FrameResult, place: Place) -> dict[str, NDArray[Any]]:
    """Return the arrays of a frame."""
    arrays: dict[str, Any] = {f"states.{name}": values for name, values in result.states.items()}
    arrays |= {f"info.{name}": values for name, values in result.info._asdict().items() if name not in MAPPINGS}
    for mapping in MAPPINGS:
        arrays |= {f"{mapping}.{name}": values for name, values in getattr(result.info, mapping).items()}
    arrays |= {f"figures.{name}": values for name, values in result.figures.items()}
    arrays |= {name: getattr(result, name) for name in ("log_weights", "seen", "seconds", "seconds_ready", "restarted")}
    return {name: np.asarray(values) for name, values in (arrays | place._asdict()).items()}


def place_of(arrays: Mapping[str, NDArray[Any]]) -> Place:
    """Return where a frame belongs.

    Raises:
        KeyError, TypeError, ValueError: the arrays are not those of a frame.
    """
    return Place(str(arrays["run"]), int(arrays["number"]), str(arrays["before"]))


def result_of(arrays: Mapping[str, NDArray[Any]]) -> FrameResult:
    """Return the frame of its arrays.

    Raises:
        KeyError, TypeError, ValueError: the arrays are not those of a frame.
    """
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
        figures=_under("figures.", arrays),
    )


def digest_of(arrays: Mapping[str, NDArray[Any]]) -> str:
    """Return the SHA-256 of the arrays: names, types, shapes and bytes."""
    digest = hashlib.sha256()
    for name in sorted(arrays):
        values = arrays[name]
        digest.update(f"{name!r} {values.dtype.str} {values.shape}\n".encode())
        digest.update(values.tobytes())
    return digest.hexdigest()


def _under(prefix: str, arrays: Mapping[str, NDArray[Any]]) -> dict[str, NDArray[Any]]:
    return {name.removeprefix(prefix): values for name, values in arrays.items() if name.startswith(prefix)}


KIND, REMEDY = "the frames of a finished run", "compute them again with --resume"
# Blocks of frames that stay in memory: readers go through the frames in order, and look back one frame.
BLOCKS_IN_MEMORY = 2
# Bytes of a block, if its chunk has not more. To look up the arrays of a small block takes longer than to read them.
BLOCK_BYTES = 8_000_000


class FrameArchive:
    """The first frames of a run, whose draws are in its posterior.

    Args:
        posterior: the file.
        run: the id of the run.
        names: names of the arrays of a frame that are in the posterior.
        entries: what else belongs to each frame, in the order in which they were stored.
        last_first: whether the frames were stored from the last to the first.
        trusted: whether this process wrote the posterior, so that HDF5 may open it without a look at it by another process.
    """

    def __init__(self, posterior: Path, run: str, names: Sequence[str], entries: Entries, last_first: bool, trusted: bool = False):
        self.posterior, self.run, self.names, self.entries = posterior, run, tuple(names), entries
        self.last_first, self.trusted = last_first, trusted
        self._block = lru_cache(BLOCKS_IN_MEMORY)(self._read_block)

    def __len__(self) -> int:
        return len(self.entries)

    def load(self, number: int) -> Stored:
        """Return a frame, and verify its digest.

        Raises:
            InputError: the posterior is missing or damaged, or it is not the one that was made of these frames.
        """
        try:
            arrays = self._arrays(number)
            result = result_of(arrays)
        except (KeyError, TypeError, ValueError, IndexError, OSError, RuntimeError) as error:
            fault = "missing" if not self.posterior.exists() else f"cannot be read ({type(error).__name__}: {error})"
            raise input_error(self.posterior, fault, f"the draws of frame {number}", REMEDY) from None
        if digest_of(arrays) != self.entries[number].digest:
            raise input_error(self.posterior, f"other draws of frame {number} than those that were computed", KIND, REMEDY)
        return Stored(result, place_of(arrays), self.entries[number].digest)

    def _arrays(self, number: int) -> dict[str, NDArray[Any]]:
        if not self.posterior.is_file():
            raise FileNotFoundError(self.posterior)
        size, length = _size_and_block(self.posterior, self.names, self.trusted)
        frame = size - 1 - number if self.last_first else number
        block = self._block(frame // length * length, length)
        entry = self.entries[number]
        place = Place(self.run, number, self.entries[number - 1].digest if number else "")
        entry_fields = {"seconds": entry.seconds, "seconds_ready": entry.seconds_ready, "restarted": entry.restarted, **place._asdict()}
        return {name: values[frame % length] for name, values in block.items()} | {name: np.asarray(value) for name, value in entry_fields.items()}

    def _read_block(self, first: int, length: int) -> dict[str, NDArray[Any]]:
        """Return arrays of some frames, with the axis of the frames first."""
        import h5py

        arrays = {}
        with h5py.File(self.posterior, "r") as file:
            for name in self.names:
                array, axis = _dataset(file, name), frame_axis_of(name)
                values = np.asarray(array[(*(slice(None),) * axis, slice(first, first + length))])
                boolean = array.attrs.get("dtype") == "bool"
                arrays[name] = np.moveaxis(values.astype(bool) if boolean else values, axis, 0)
        return arrays

    def write(self, folder: Path) -> None:
        """Write the index.

        Raises:
            InputError: the file system does not accept it.
        """
        arrays: dict[str, NDArray[Any]] = {
            "run": np.array(self.run),
            "names": np.array(self.names),
            **self.entries.arrays(),
            "last_first": np.array(self.last_first),
        }
        with replacing(folder / INDEX_FILE) as partial, partial.open("wb") as file:
            np.savez(file, allow_pickle=False, **arrays, digest=np.array(digest_of(arrays)))


def read_archive(folder: Path, posterior: Path) -> FrameArchive | None:
    """Return the archive of a folder of frames; None if it has none.

    Raises:
        InputError: the index is damaged.
    """
    path = folder / INDEX_FILE
    if not path.exists():
        return None
    arrays = read_arrays(path, None, KIND, REMEDY)
    try:
        digest = str(arrays.pop("digest"))
        archive = FrameArchive(posterior, str(arrays["run"]), arrays["names"].tolist(), entries_of(arrays), bool(arrays["last_first"]))
    except (KeyError, TypeError, ValueError) as error:
        raise input_error(path, f"cannot be read ({type(error).__name__}: {error})", KIND, REMEDY) from None
    if digest != digest_of(arrays):
        raise input_error(path, "was changed since it was written (its digest is another)", KIND, REMEDY)
    return archive


def _dataset(file: "h5py.File", name: str) -> "h5py.Dataset":
    """Return an array of the posterior by its name in a frame.

    Raises:
        KeyError, TypeError: there is none.
    """
    import h5py

    array = file[place_in_tree(name)]
    if not isinstance(array, h5py.Dataset):
        raise TypeError(f"{name} is no array")
    return array


def in_posterior(arrays: Mapping[str, NDArray[Any]]) -> list[str]:
    """Return the names of the arrays of a frame that the posterior has."""
    return [name for name in arrays if place_in_tree(name)]


def _size_and_block(posterior: Path, names: Sequence[str], trusted: bool) -> tuple[int, int]:
    """Return the number of frames of a posterior, and how many of them are read at once."""
    stat = posterior.stat()
    return _looked_at(posterior, tuple(names), trusted, (stat.st_mtime_ns, stat.st_size, stat.st_ino))


@lru_cache(8)
def _looked_at(posterior: Path, names: Sequence[str], trusted: bool, version: tuple[int, ...]) -> tuple[int, int]:
    """Look at a version of a file once. `version` is there for the cache."""
    import h5py

    del version
    if not trusted:
        try:
            check_plain(posterior)
        except InputError as fault:
            raise OSError(str(fault)) from None
    with h5py.File(posterior, "r") as file:
        array, axis = _dataset(file, names[0]), frame_axis_of(names[0])
        frames, chunk = int(array.shape[axis]), max(int(array.chunks[axis] if array.chunks else 1), 1)
        in_block = BLOCK_BYTES * frames // max(posterior.stat().st_size, 1)
        return frames, chunk * max(in_block // chunk, 1)
