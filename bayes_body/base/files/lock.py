"""One process per run: a lock of the operating system, which ends with the process however it ends."""

import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from filelock import FileLock, Timeout

from bayes_body.base.errors import input_error
from bayes_body.base.files.atomic import make_folder, refused

NAME = ".lock"


@contextmanager
def locked(folder: Path) -> Iterator[None]:
    """Lock the folder of a run, which is made if needed; the lock file names the process.

    If the block fails and has written nothing, a folder that was made is removed again.

    Raises:
        InputError: another process holds it, or the file system refuses the lock.
    """
    made = _made(folder)
    path = folder / NAME
    _check_own(path)
    lock = FileLock(path, timeout=0, is_singleton=False)
    try:
        lock.acquire()
        path.write_text(str(os.getpid()), encoding="utf-8")
    except Timeout:
        raise input_error(
            folder, f"{_holder(path)} works on it", "a separate folder for each process", "wait for it, or name another folder"
        ) from None
    except OSError as error:
        lock.release()
        raise refused(path, "written", error) from None
    try:
        yield
    except BaseException:
        if made and {entry.name for entry in folder.iterdir()} <= {NAME}:
            path.unlink(missing_ok=True)
            _remove(made)
        raise
    finally:
        lock.release()


def _made(folder: Path) -> list[Path]:
    """Make a folder with its parents. Return the folders that did not exist, the innermost first."""
    missing = []
    for path in (folder, *folder.parents):
        if path.exists():
            break
        missing.append(path)
    make_folder(folder)
    return missing


def _remove(folders: list[Path]) -> None:
    """Remove folders, as far as they are empty."""
    with suppress(OSError):
        for path in folders:
            path.rmdir()


def _check_own(path: Path) -> None:
    """Refuse a lock file that leads to another file, which would be overwritten."""
    if path.is_symlink() or (path.exists() and (not path.is_file() or path.stat().st_nlink > 1)):
        raise input_error(path, "a link, or no plain file", "a file of the program's own", "remove it")


def _holder(path: Path) -> str:
    try:
        number = path.read_text(encoding="utf-8").strip()
    except OSError:
        number = ""
    return f"process {number}" if number else "another process"
