"""Write folders and files for a user: completely or not at all. Errors of the file system become an InputError.

A user's own file is never replaced unless the user says so. A page of this program is recognised by a mark.

HDF5 gets a special file for a disk that may fill up. HDF5 does not survive a failed write: it tries again on closing and crashes the process. This
file keeps in memory what the disk refuses, so that HDF5 can close, and reports the error afterwards. Writers should check `error` regularly and stop,
so that little is kept.
"""

import io
import os
import re
import secrets
from collections.abc import Buffer, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path

from bayes_body.base.errors import InputError, input_error

# Temporary files begin so. They keep the file's own suffix, for writers that depend on it.
PARTIAL = ".partial-"
# Bytes of the random part of their names.
RANDOM = 8
# Files that are written at once.
AT_ONCE = 4
RANDOM_NAME = re.compile(rf"{re.escape(PARTIAL)}[0-9a-f]{{{2 * RANDOM}}}(\.[^.]*)?")


def make_folder(path: Path) -> Path:
    """The folder, created with its parents if needed.

    Raises:
        InputError: it cannot be made.
    """
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise refused(path, "made", error) from None
    return path


def write_text(path: Path, text: str) -> None:
    """Write a text in UTF-8, completely or not at all.

    Raises:
        InputError: it cannot be written.
    """
    with replacing(path) as partial:
        partial.write_text(text, encoding="utf-8")


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Yield a temporary name in the same folder. The file written there replaces `path` after the block, once its content is on the disk.

    If the block is interrupted, `path` is unchanged or complete, and the temporary file is removed. The name is random and the file is new: a link
    that somebody left in the folder is not followed. If `path` itself is a link, the link is replaced, not the file that it leads to.

    Raises:
        InputError: the file system refuses it.
    """
    partial = path.with_name(PARTIAL + secrets.token_hex(RANDOM) + path.suffix)
    try:
        _make_new(partial)
        yield partial
        _sync(partial)
        partial.replace(path)
        _sync(path.parent)
    except BaseException as error:
        _remove(partial)
        if isinstance(error, OSError):
            raise refused(path, "written", error) from None
        raise


def write_together(contents: Mapping[Path, Buffer]) -> None:
    """Write files of one folder, and return once all are on the disk. Each is written completely or not at all; those that exist are replaced.

    The disk gets some files at once: to wait for one of them takes longer than to write it.

    Raises:
        InputError: the file system refuses one of them. Files before it may be there.
    """
    partials = {path: path.with_name(PARTIAL + secrets.token_hex(RANDOM) + path.suffix) for path in contents}
    try:
        with ThreadPoolExecutor(AT_ONCE, thread_name_prefix="disk") as pool:
            written = [(path, pool.submit(_write_new, partial, contents[path])) for path, partial in partials.items()]
        for path, outcome in written:
            with _refusing(path):
                outcome.result()
                partials[path].replace(path)
        for folder in {path.parent for path in contents}:
            with _refusing(folder):
                _sync(folder)
    except BaseException:
        for partial in partials.values():
            _remove(partial)
        raise


def _write_new(path: Path, content: Buffer) -> None:
    _make_new(path)
    path.write_bytes(content)
    _sync(path)


@contextmanager
def _refusing(path: Path) -> Iterator[None]:
    """Turn an error of the file system into an InputError."""
    try:
        yield
    except OSError as error:
        raise refused(path, "written", error) from None


def _make_new(path: Path) -> None:
    """Make an empty file where there is nothing yet, not even a link."""
    os.close(os.open(path, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o666))


def _sync(path: Path) -> None:
    """Wait until a file's content, or a folder's list of files, is on the disk."""
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def _remove(path: Path) -> None:
    try:
        path.unlink(missing_ok=True)
    except OSError:
        # What could not be written may not be removable either; the first error is the one to report.
        return


def remove_partial(folder: Path) -> None:
    """Remove what an interrupted `replacing` left in a folder.

    Raises:
        InputError: the file system refuses it.
    """
    for path in folder.glob(f"{PARTIAL}*"):
        if not RANDOM_NAME.fullmatch(path.name):
            # It has another name than this program gives.
            continue
        try:
            path.unlink()
        except OSError as error:
            raise refused(path, "removed", error) from None


def refused(path: Path, done: str, error: OSError) -> InputError:
    """The error for a file system that refuses to let `path` be `done`."""
    reason = os.strerror(error.errno) if error.errno else str(error)
    return input_error(path, f"cannot be {done} ({reason})", "a writable folder with free space", "name another folder, or free some space")


# A page has its mark within so many first bytes.
HEAD = 1000


def check_free(file: Path, overwrite: bool) -> None:
    """Check that a command may write a file that the user named.

    Args:
        file: the file.
        overwrite: whether an existing one may be replaced.

    Raises:
        InputError: it exists and may not be replaced, it is a folder, or the file system refuses its name.
    """
    try:
        folder, exists = file.is_dir(), file.exists() or file.is_symlink()
    # For example, the name is too long.
    except OSError as error:
        raise refused(file, "written", error) from None
    if folder:
        raise input_error(file, "a folder", "the name of a file", "name a file in it with --out")
    if exists and not overwrite:
        raise input_error(file, "already exists", "a file that does not exist yet", "name another with --out, or replace it with --overwrite")


def has_mark(file: Path, mark: bytes) -> bool:
    """Return whether a file begins like a page of this program."""
    try:
        # A pipe would have to be waited for.
        if not file.is_file():
            return False
        with file.open("rb") as opened:
            return mark in opened.read(HEAD)
    except OSError:
        return False


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
