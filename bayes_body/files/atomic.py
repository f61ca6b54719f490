"""Folders and files written for a user: whole or not at all; what the file system refuses is said as a sentence."""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from bayes_body.errors import InputError, input_error

# Before the name, so that a writer that goes by the ending sees the file's own.
PARTIAL = ".partial-"


def make_folder(path: Path) -> Path:
    """The folder, made with its parents if need be.

    Raises:
        InputError: it cannot be made.
    """
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise refused(path, "made", error) from None
    return path


def write_text(path: Path, text: str) -> None:
    """Write a text in UTF-8, whole or not at all.

    Raises:
        InputError: it cannot be written.
    """
    with replacing(path) as partial:
        partial.write_text(text, encoding="utf-8")


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """A name in the same folder to write to, which takes the place of `path` once the block is through and its content is on the disk.

    Whatever interrupts the block, `path` is as it was before, or whole; what is left of the other name is removed, or written over the next time.

    Raises:
        InputError: the file system refuses it.
    """
    partial = path.with_name(PARTIAL + path.name)
    try:
        yield partial
        _sync(partial)
        partial.replace(path)
        _sync(path.parent)
    except BaseException as error:
        _remove(partial)
        if isinstance(error, OSError):
            raise refused(path, "written", error) from None
        raise


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
        # What could not be written may not be removable either; the first error is the one to tell.
        return


def remove_partial(folder: Path) -> None:
    """Remove what an interrupted `replacing` has left in a folder.

    Raises:
        InputError: the file system refuses it.
    """
    for path in folder.glob(f"{PARTIAL}*"):
        try:
            path.unlink()
        except OSError as error:
            raise refused(path, "removed", error) from None


def refused(path: Path, done: str, error: OSError) -> InputError:
    """What to say when the file system does not let something be `done` to `path`."""
    reason = os.strerror(error.errno) if error.errno else str(error)
    return input_error(path, f"cannot be {done} ({reason})", "a folder that can be written, with room", "name another folder, or free some space")
