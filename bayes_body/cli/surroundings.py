"""Errors that come from the surroundings of the program, not from a fault in it: the current folder, files, the memory, the platform of JAX.

A command that is stopped by Ctrl-C or by SIGTERM ends in order: temporary files are removed, and `track` says how to continue.
"""

import os
import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import FrameType

from bayes_body.base.errors import InputError, input_error


def check_current_folder() -> None:
    """Refuse to work in a folder that was deleted: no path could be trusted there, and libraries fail in their own ways.

    Raises:
        InputError: there is no current folder.
    """
    try:
        Path.cwd()
    except OSError:
        raise input_error("the current folder", "does not exist any more", "a folder that exists", "change to another folder") from None


def fault_of_surroundings(error: Exception) -> InputError | None:
    """Return the sentence about an error that the surroundings explain; None if it is a fault of the program."""
    if isinstance(error, OSError):
        return _of_files(error)
    if isinstance(error, MemoryError) or "RESOURCE_EXHAUSTED" in str(error):
        problem = f"not enough for this command ({str(error).splitlines()[0] if str(error) else 'out of memory'})"
        return input_error("memory", problem, "a command that fits", "give fewer particles, runs or frames, or use a machine with more memory")
    return _of_platform()


def _of_files(error: OSError) -> InputError | None:
    if error.filename is None or not error.errno:
        return None
    path = os.fsdecode(error.filename) if isinstance(error.filename, bytes) else error.filename
    problem = f"cannot be used ({os.strerror(error.errno)})"
    return input_error(path, problem, "a file or folder that can be used", "check the path, its permissions and the free space")


def _of_platform() -> InputError | None:
    """Return a sentence if JAX does not have the platform that the environment names: JAX then raises errors of any kind."""
    name, jax = os.environ.get("JAX_PLATFORMS"), sys.modules.get("jax")
    if not name or jax is None:
        return None
    try:
        jax.devices()
    except Exception as error:
        reason = str(error).splitlines()[0] if str(error) else "no such device"
        return input_error(f"the environment variable JAX_PLATFORMS={name}", reason, "a platform of this machine, such as cpu", "correct or unset it")
    return None


# Exit statuses: 128 and the number of the signal.
INTERRUPTED, TERMINATED = 130, 143
STOPPED = {INTERRUPTED: "interrupted", TERMINATED: "terminated"}


@contextmanager
def stoppable() -> Iterator[None]:
    """Within it, the first SIGTERM raises SystemExit, and a second one ends the process at once. A signal that is ignored or handled stays so."""
    if threading.current_thread() is not threading.main_thread() or signal.getsignal(signal.SIGTERM) is not signal.SIG_DFL:
        yield
        return
    signal.signal(signal.SIGTERM, _stop)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, signal.SIG_DFL)


def _stop(number: int, frame: FrameType | None) -> None:
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    raise SystemExit(TERMINATED)
