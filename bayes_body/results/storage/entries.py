"""What a posterior lacks of the frames of its run, in columns: some 60 bytes a frame, where an object for each frame would take ten times as much."""

from array import array
from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

# Bytes of a digest, SHA-256.
DIGEST_BYTES = 32


class Entry(NamedTuple):
    """What the posterior lacks of a frame.

    Attributes:
        digest: the frame's digest.
        seconds: as in `FrameResult`.
        seconds_ready: as in `FrameResult`.
        restarted: as in `FrameResult`: one value for each run, or none.
    """

    digest: str
    seconds: float
    seconds_ready: float
    restarted: NDArray[np.bool_]


class Entries:
    """The entries of successive frames."""

    def __init__(self) -> None:
        self._digests, self._restarted = bytearray(), bytearray()
        self._seconds, self._seconds_ready, self._ends = array("d"), array("d"), array("q")

    def __len__(self) -> int:
        return len(self._seconds)

    def __getitem__(self, number: int, /) -> Entry:
        if not 0 <= number < len(self):
            raise IndexError(number)
        digest = self._digests[DIGEST_BYTES * number : DIGEST_BYTES * (number + 1)].hex()
        flags = self._restarted[self._ends[number - 1] if number else 0 : self._ends[number]]
        return Entry(digest, self._seconds[number], self._seconds_ready[number], np.array(flags, bool))

    def __iter__(self) -> Iterator[Entry]:
        return (self[number] for number in range(len(self)))

    def append(self, entry: Entry) -> None:
        """Add the entry of the next frame.

        Raises:
            ValueError: the digest is none.
        """
        digest = bytes.fromhex(entry.digest)
        if len(digest) != DIGEST_BYTES:
            raise ValueError(f"a digest of {len(digest)} bytes")
        self._digests += digest
        self._seconds.append(entry.seconds)
        self._seconds_ready.append(entry.seconds_ready)
        self._restarted += entry.restarted.astype(bool).tobytes()
        self._ends.append(len(self._restarted))

    def arrays(self) -> dict[str, NDArray[Any]]:
        """Return the columns as `entries_of` reads them."""
        return {
            "digests": np.array([entry.digest for entry in self], "S"),
            "seconds": np.array(self._seconds),
            "seconds_ready": np.array(self._seconds_ready),
            "restarted": np.array(self._restarted, bool),
            "restarted_sizes": np.diff(np.array(self._ends), prepend=0),
        }


def entries_of(arrays: Mapping[str, NDArray[Any]]) -> Entries:
    """Return the entries of their columns.

    Raises:
        KeyError, TypeError, ValueError: the arrays are not those of entries.
    """
    entries, ends = Entries(), np.cumsum(arrays["restarted_sizes"])
    flags = arrays["restarted"].astype(bool)
    columns = (arrays["digests"].astype(str), arrays["seconds"], arrays["seconds_ready"], ends - arrays["restarted_sizes"], ends)
    for digest, seconds, seconds_ready, start, stop in zip(*columns, strict=True):
        entries.append(Entry(str(digest), float(seconds), float(seconds_ready), flags[start:stop]))
    return entries
