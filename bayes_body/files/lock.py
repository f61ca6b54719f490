"""One process per run: a lock of the operating system, which ends with the process however it ends."""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from filelock import FileLock, Timeout

from bayes_body.errors import input_error
from bayes_body.files.atomic import refused

NAME = ".lock"


@contextmanager
def locked(folder: Path) -> Iterator[None]:
    """Lock the folder of a run; the lock file names the process.

    Raises:
        InputError: another process holds it, or the file system refuses the lock.
    """
    path = folder / NAME
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
    finally:
        lock.release()


def check_unlocked(folder: Path) -> None:
    """Refuse a folder that another process works on, without writing anything into it.

    Raises:
        InputError: as for `locked`.
    """
    if (folder / NAME).exists():
        with locked(folder):
            pass


def _holder(path: Path) -> str:
    try:
        number = path.read_text(encoding="utf-8").strip()
    except OSError:
        number = ""
    return f"process {number}" if number else "another process"
