"""Progress on standard error: a bar on a terminal or in a notebook; elsewhere lines, for a log.

In a log, work prints a line when it begins, if it may take long before anything can be counted; then one after every 5 %, but no two within ten
seconds. After a minute without a line, one is printed in any case, so that a log tells slow work from work that hangs.
"""

import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from typing import Self

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from rich.progress import Progress as Bar
from rich.progress import track as follow

from bayes_body.base.errors import printable

STEP, LEAST_S, MOST_S = 0.05, 10.0, 60.0
ROUNDING = 1e-9


class ProgressLog:
    """The lines about one piece of work, from entering to leaving it.

    Args:
        work: the work.
        unit: what a step is.
        clock: seconds that never go back.
    """

    def __init__(self, work: str, unit: str = "", clock: Callable[[], float] = time.monotonic):
        self.work, self.unit, self._clock = work, unit, clock
        self._lock, self._over = threading.Lock(), threading.Event()
        self._state, self._lines, self._next = "", 0, STEP
        self._begun = self._last = clock()

    def __enter__(self) -> Self:
        threading.Thread(target=self._beat, name="progress", daemon=True).start()
        return self

    def __exit__(self, *_: object) -> None:
        self._over.set()

    def begin(self, doing: str = "") -> None:
        """Say that the work begins, and what it is doing until its first step is done."""
        self._state = doing
        self._say("" if doing else " ...")

    def move(self, done: int, total: int, figures: str = "", step_s: float | None = None) -> None:
        """Note that so many steps are done, and say so if that is due.

        Args:
            done: number of steps.
            total: of all steps.
            figures: further words about the last step.
            step_s: seconds a step; by default those since the beginning, divided by the steps.
        """
        share, time_s = done / max(total, 1), self._clock()
        self._state = ", ".join([f"{self.unit} {done} of {total} ({100 * share:.0f} %)".strip(), *([figures] if figures else [])])
        if share >= 1:
            if self._lines:
                self._say(f", {_duration(time_s - self._begun)} in all")
        elif share >= self._next and time_s - self._last >= LEAST_S:
            self._next = share + STEP - ROUNDING
            remaining_s = (total - done) * ((time_s - self._begun) / max(done, 1) if step_s is None else step_s)
            self._say(f", about {_duration(remaining_s)} left")

    def remind(self) -> None:
        """Say how far the work is if nothing was said for a minute."""
        time_s = self._clock()
        if time_s - self._last >= MOST_S:
            self._say(f"{', ' if self._state else ': '}{_duration(time_s - self._begun)} so far")

    def _beat(self) -> None:
        while not self._over.wait(LEAST_S):
            self.remind()

    def _say(self, end: str) -> None:
        with self._lock:
            self._last, self._lines = self._clock(), self._lines + 1
            text = f"{self.work}{self._state and ': '}{self._state}{end}"
            print(printable(f"[{time.strftime('%H:%M:%S')}] {text}"), file=sys.stderr, flush=True)


def logged(work: str, items: Sequence[int]) -> Iterator[int]:
    """Yield the items, and log how many are done."""
    with ProgressLog(work) as log:
        for done, item in enumerate(items, 1):
            yield item
            log.move(done, len(items))


def _duration(seconds: float) -> str:
    if seconds < 90:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 5400 else f"{seconds / 3600:.1f} h"


type Watch = Callable[[Sequence[int]], Iterable[int]]


def unwatched(frames: Sequence[int]) -> Iterable[int]:
    """Return the frames, without a progress bar."""
    return frames


def watched(work: str, visible: bool = True) -> Watch:
    """Return a function that shows the progress over its frames, for work without further figures, such as drawing."""
    if not visible:
        return unwatched
    return lambda frames: follow(frames, work, console=Console(stderr=True), transient=True) if draws_bars() else logged(work, frames)


@contextmanager
def waiting(work: str, visible: bool = True) -> Iterator[None]:
    """Show that work of unknown duration is in progress."""
    if not visible:
        yield
    elif draws_bars():
        with Console(stderr=True).status(work):
            yield
    else:
        with ProgressLog(work) as log:
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


@contextmanager
def units_bar(total: int) -> Iterator[Callable[[int, str], None]]:
    """Yield a function that takes the number of units of work that have ended, and words about those that run, side by side."""
    columns = (TextColumn("units, {task.description}"), MofNCompleteColumn(), BarColumn(), TimeElapsedColumn(), TimeRemainingColumn())
    if draws_bars():
        with Bar(*columns, console=Console(stderr=True), transient=True) as bar:
            task = bar.add_task("none running", total=total)
            yield lambda ended, running: bar.update(task, completed=ended, description=running)
    else:
        with ProgressLog("study", "units") as log:
            log.begin()
            yield lambda ended, running: log.move(ended, total, running)


def draws_bars() -> bool:
    """Whether a bar can be drawn."""
    return sys.stderr.isatty() or Console(stderr=True).is_jupyter
