"""All text that leaves the program for a terminal: control characters are escaped, and a stream that cannot be written does not stop the work.

Names of files, cameras and joints, and whatever else a file says, may hold escape sequences. A command prints with `say` or `show`, which write none.
"""

import io
import os
import shutil
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import Any

import typer

from bayes_body.base.errors import printable

# Columns of a table that is not printed on a terminal.
WIDTH = 160


def say(text: str = "") -> None:
    """Print lines on standard output."""
    print(printable(text), flush=True)


def show(*contents: Any) -> None:
    """Print tables of rich, or sentences, on standard output; sentences are not wrapped."""
    from rich.console import Console
    from rich.table import Table

    width = shutil.get_terminal_size().columns if sys.stdout.isatty() else WIDTH
    drawn = io.StringIO()
    console = Console(file=drawn, width=width, color_system=None, highlight=False, markup=False, emoji=False)
    for content in contents:
        console.print(content, soft_wrap=not isinstance(content, Table))
    say(drawn.getvalue().removesuffix("\n"))


def complain(text: str) -> None:
    """Print a sentence on standard error; on standard output if that is closed or cannot be written."""
    line = f"bayes-body: {printable(text)}"
    coloured = sys.stderr.isatty() and "NO_COLOR" not in os.environ
    print(typer.style(line, fg="red") if coloured else line, file=sys.stderr, flush=True)
    if getattr(sys.stderr, "error", None):
        print(line, flush=True)


class Guarded:
    """A standard stream. Its first error is kept as `error`, and all later text is dropped: a run of hours does not end because nobody reads it."""

    def __init__(self, stream: Any, error: OSError | None = None):
        self._stream, self.error = stream, error

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)

    def write(self, text: str) -> int:
        """Write, or do nothing after an error."""
        self._try(self._stream.write, text)
        return len(text)

    def flush(self) -> None:
        """Flush, or do nothing after an error."""
        self._try(self._stream.flush)

    def _try(self, method: Any, *arguments: str) -> None:
        if self.error:
            return
        try:
            method(*arguments)
        except OSError as error:
            self.error = error
            _discard(self._stream)


def _discard(stream: Any) -> None:
    """Lead a stream's file to the null device: Python writes once more what is left in its buffer, at the end."""
    with suppress(OSError, ValueError):
        null = os.open(os.devnull, os.O_WRONLY)
        os.dup2(null, stream.fileno())
        os.close(null)


@contextmanager
def guarded() -> Iterator[tuple[Guarded, Guarded]]:
    """Within it, standard output and standard error are guarded. Yield both.

    A file that is opened while one of them is closed would take its number, and receive what libraries of C write there. So a closed one is opened on
    the null device.
    """
    for number in range(3):
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, os.O_RDWR)
    streams_before = sys.stdout, sys.stderr
    sys.stdout, sys.stderr = streams = _guard(streams_before[0]), _guard(streams_before[1])
    try:
        yield streams
    finally:
        sys.stdout, sys.stderr = streams_before


def _guard(stream: Any) -> Guarded:
    if stream is None:
        # Python has no stream for a file that was closed when it started.
        return Guarded(io.StringIO(), OSError("closed"))
    if hasattr(stream, "reconfigure"):
        # A terminal of ASCII shows the other characters by their numbers.
        stream.reconfigure(errors="backslashreplace")
    return Guarded(stream)
