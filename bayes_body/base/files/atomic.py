"""Write folders and files for a user: completely or not at all. What the file system refuses becomes an InputError."""

import os
import re
import secrets
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from bayes_body.base.errors import InputError, input_error

# Temporary files begin so. They keep the file's own suffix, for writers that depend on it.
PARTIAL = ".partial-"
# Bytes of the random part of their names.
RANDOM = 8
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
