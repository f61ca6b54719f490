"""A file for HDF5 on a disk that may fill up.

HDF5 does not survive a write that fails: it tries again while it closes and brings the process down. This file holds what the disk refuses in memory,
so that HDF5 can close, and says afterwards what happened. Whoever writes looks at `error` now and then and stops, so that little is held.
"""

import io
import os
from collections.abc import Buffer
from pathlib import Path


class ErrorDeferringFile(io.RawIOBase):
    """A new file to read and write, whose writes never fail.

    Args:
        path: its name; what was there is overwritten.

    Attributes:
        error: what the disk refused first; None as long as all went well. The file is of no use then.
    """

    def __init__(self, path: Path):
        super().__init__()
        self.error: OSError | None = None
        self._handle = os.open(path, os.O_RDWR | os.O_CREAT | os.O_TRUNC, 0o666)
        self._place = self._size = 0
        self._held: list[tuple[int, bytes]] = []

    def readable(self) -> bool:
        """It is."""
        return True

    def writable(self) -> bool:
        """It is."""
        return True

    def seekable(self) -> bool:
        """It is."""
        return True

    def seek(self, offset: int, whence: int = os.SEEK_SET, /) -> int:
        """Go to a place, counted from the start, from here or from the end."""
        self._place = offset + {os.SEEK_SET: 0, os.SEEK_CUR: self._place, os.SEEK_END: self._size}[whence]
        return self._place

    def readinto(self, buffer: Buffer, /) -> int:
        """What was written, whether the disk took it or not."""
        view = memoryview(buffer).cast("B")
        count = max(0, min(len(view), self._size - self._place))
        found = os.pread(self._handle, count, self._place)
        view[:count] = found.ljust(count, b"\0")
        for start, data in self._held:
            first, last = max(start, self._place), min(start + len(data), self._place + count)
            if first < last:
                view[first - self._place : last - self._place] = data[first - start : last - start]
        self._place += count
        return count

    def write(self, data: Buffer, /) -> int:
        """All of it, always."""
        content = bytes(data)
        if not self.error:
            self._try_to_write(content)
        if self.error:
            self._held.append((self._place, content))
        if content:
            self._place += len(content)
            self._size = max(self._size, self._place)
        return len(content)

    def _try_to_write(self, content: bytes) -> None:
        written = 0
        try:
            while written < len(content):
                written += os.pwrite(self._handle, content[written:], self._place + written)
        except OSError as error:
            self.error = error

    def truncate(self, size: int | None = None, /) -> int:
        """Give it a size; zeros where it grows."""
        self._size = self._place if size is None else size
        try:
            os.ftruncate(self._handle, self._size)
        except OSError as error:
            self.error = self.error or error
        return self._size

    def close(self) -> None:
        """Let go of it."""
        if not self.closed:
            os.close(self._handle)
        super().close()
