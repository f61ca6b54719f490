"""Progress on standard error: a bar on a terminal or in a notebook; elsewhere lines, for a log (base/progress_log.py)."""

import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, TextColumn, TimeElapsedColumn
from rich.progress import Progress as Bar
from rich.progress import track as follow

from bayes_body.base.progress_log import ProgressLog, logged

type Watch = Callable[[Sequence[int]], Iterable[int]]


def unwatched(frames: Sequence[int]) -> Iterable[int]:
    """Return the frames, without a progress bar."""
    return frames


def watched(what: str, visible: bool = True) -> Watch:
    """Return a function that shows the progress over its frames, for work without further figures, such as drawing."""
    if not visible:
        return unwatched
    return lambda frames: follow(frames, what, console=Console(stderr=True), transient=True) if draws_bars() else logged(what, frames)


@contextmanager
def waiting(what: str, visible: bool = True) -> Iterator[None]:
    """Show that work of unknown duration is in progress."""
    if not visible:
        yield
    elif draws_bars():
        with Console(stderr=True).status(what):
            yield
    else:
        with ProgressLog(what) as log:
            log.begin()
            yield


@contextmanager
def steps_bar(total: int, doing: str) -> Iterator[Callable[[int, str], None]]:
    """Yield a function that takes the number of steps done and what comes next. `doing` is the first step."""
    columns = (TextColumn("{task.description}"), MofNCompleteColumn(), BarColumn(), TimeElapsedColumn())
    if draws_bars():
        with Bar(*columns, console=Console(stderr=True), transient=True) as bar:
            task = bar.add_task(doing, total=total)
            yield lambda done, doing: bar.update(task, completed=done, description=doing)
    else:
        with ProgressLog("steps") as log:
            log.begin(doing)
            yield lambda done, doing: log.move(done, total, f"next {doing}" if done < total else "")


def draws_bars() -> bool:
    """Whether a bar can be drawn."""
    return sys.stderr.isatty() or Console(stderr=True).is_jupyter
