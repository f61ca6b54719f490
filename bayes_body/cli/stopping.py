"""A command that is stopped by Ctrl-C or by SIGTERM ends in order: temporary files are removed, and `track` says how to continue."""

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

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
