"""A file for HDF5 on a disk that may fill up.

HDF5 does not survive a failed write: it tries again on closing and crashes the process. This file keeps in memory what the disk refuses, so that HDF5
can close, and reports the error afterwards. Writers should check `error` regularly and stop, so that little is kept.
"""

import io
import os
from collections.abc import Buffer
from pathlib import Path


class ErrorDeferringFile(io.RawIOBase):
    """A new file for reading and writing, whose writes never fail.

    Args:
        path: its name; an existing file is overwritten.

    Attributes:
        error: the first error of the disk; None while there is none. After an error the file is useless.
    """

    def __init__(self, path: Path):
        super().__init__()
        self.error: OSError | None = None
        self._handle = os.open(path, os.O_RDWR | os.O_CREAT | os.O_TRUNC, 0o666)
        self._place = self._size = 0
        self._held: list[tuple[int, bytes]] = []

    def readable(self) -> bool:
        """Always true."""
        return True

    def writable(self) -> bool:
        """Always true."""
        return True

    def seekable(self) -> bool:
        """Always true."""
        return True

    def seek(self, offset: int, whence: int = os.SEEK_SET, /) -> int:
        """Set the position, relative to the start, to the current position or to the end."""
        self._place = offset + {os.SEEK_SET: 0, os.SEEK_CUR: self._place, os.SEEK_END: self._size}[whence]
        return self._place

    def readinto(self, buffer: Buffer, /) -> int:
        """Read what was written, whether the disk accepted it or not."""
        view = memoryview(buffer).cast("B")
        count = max(0, min(len(view), self._size - self._place))
        content = os.pread(self._handle, count, self._place)
        view[:count] = content.ljust(count, b"\0")
        for start, data in self._held:
            first, last = max(start, self._place), min(start + len(data), self._place + count)
            if first < last:
                view[first - self._place : last - self._place] = data[first - start : last - start]
        self._place += count
        return count

    def write(self, data: Buffer, /) -> int:
        """Accept all of the data."""
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
        """Set the size; the file grows with zeros."""
        self._size = self._place if size is None else size
        try:
            os.ftruncate(self._handle, self._size)
        except OSError as error:
            self.error = self.error or error
        return self._size

    def close(self) -> None:
        """Close the file."""
        if not self.closed:
            os.close(self._handle)
        super().close()
