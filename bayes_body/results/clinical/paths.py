"""The paths of draws through all frames, which are read one draw at a time.

A posterior is stored by frames, and a path goes through all of them. Of a long recording all paths together do not fit into the memory. So they are
written into a temporary file as the frames are read, and read from there draw by draw.
"""

import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Protocol

import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray

from bayes_body.base.files.atomic import refused

# Up to this size, bytes, the paths stay in memory.
IN_MEMORY = 2**25


class PathsOfDraws(Protocol):
    """Paths (draw, frame, ...): an array, or a file."""

    @property
    def shape(self) -> tuple[int, ...]:
        """The numbers of draws and frames, and the shape of a draw in a frame."""
        ...

    def __len__(self) -> int: ...

    def __getitem__(self, draw: int, /) -> NDArray[np.floating]: ...

    def __iter__(self) -> Iterator[NDArray[np.floating]]: ...


class StoredPaths:
    """Paths in a file that is gone with this object; small ones are in memory.

    Args:
        shape: the numbers of draws and frames, and the shape of a draw in a frame.
    """

    def __init__(self, shape: tuple[int, ...]):
        self.shape = shape
        self._file = tempfile.SpooledTemporaryFile(IN_MEMORY)  # noqa: SIM115 (it is closed with this object)

    def __len__(self) -> int:
        return self.shape[0]

    def __getitem__(self, draw: int, /) -> Float[np.ndarray, "frame *of"]:
        if not 0 <= draw < len(self):
            raise IndexError(draw)
        self._file.seek(draw * self._path_bytes)
        return np.frombuffer(self._file.read(self._path_bytes)).reshape(self.shape[1:])

    def __iter__(self) -> Iterator[Float[np.ndarray, "frame *of"]]:
        return (self[draw] for draw in range(len(self)))

    @property
    def _path_bytes(self) -> int:
        return 8 * int(np.prod(self.shape[1:], dtype=np.int64))

    def write(self, first: int, block: Float[np.ndarray, "draw frame *of"]) -> None:
        """Store some frames of all paths, from frame `first` on.

        Raises:
            InputError: the disk is full.
        """
        for draw, frames in enumerate(block):
            self._put(draw, first, frames)

    def write_path(self, draw: int, path: Float[np.ndarray, "frame *of"]) -> None:
        """Replace a path.

        Raises:
            InputError: the disk is full.
        """
        self._put(draw, 0, path)

    def _put(self, draw: int, first: int, frames: NDArray[np.floating]) -> None:
        try:
            self._file.seek(draw * self._path_bytes + first * self._path_bytes // max(self.shape[1], 1))
            self._file.write(np.ascontiguousarray(frames, np.float64).tobytes())
            self._file.flush()
        except OSError as error:
            raise refused(Path(tempfile.gettempdir()), "written", error) from None


class ChosenColumns:
    """Some columns of paths (draw, frame, column)."""

    def __init__(self, paths: PathsOfDraws, columns: Sequence[int]):
        self._paths, self._columns = paths, list(columns)

    @property
    def shape(self) -> tuple[int, ...]:
        """The numbers of draws, frames and chosen columns."""
        return *self._paths.shape[:2], len(self._columns)

    def __len__(self) -> int:
        return len(self._paths)

    def __getitem__(self, draw: int, /) -> Float[np.ndarray, "frame column"]:
        return self._paths[draw][:, self._columns]

    def __iter__(self) -> Iterator[Float[np.ndarray, "frame column"]]:
        return (self[draw] for draw in range(len(self)))


def mean_path(paths: PathsOfDraws) -> Float[np.ndarray, "frame *of"]:
    """Return the mean over the draws."""
    total = np.zeros(paths.shape[1:])
    for path in paths:
        total += path
    return total / len(paths)


def sd_path(paths: PathsOfDraws) -> Float[np.ndarray, "frame *of"]:
    """Return the standard deviation over the draws."""
    mean, total = mean_path(paths), np.zeros(paths.shape[1:])
    for path in paths:
        total += (path - mean) ** 2
    return np.sqrt(total / len(paths))
