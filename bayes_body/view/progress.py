"""Progress on standard error: a bar on a terminal or in a notebook; elsewhere lines, for a log (view/progress_log.py).

That of a run shows frames, seconds per frame, ESS, survival rate and the time left.
"""

import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from rich.progress import Progress as Bar
from rich.progress import track as follow

from bayes_body.tracking.smooth import SmoothProgress
from bayes_body.tracking.track import Progress
from bayes_body.view.progress_log import ProgressLog, logged

type Watch = Callable[[Sequence[int]], Iterable[int]]
# What a run does before its first frame is there.
COMPILING = "compiling"


def unwatched(frames: Sequence[int]) -> Iterable[int]:
    """Return the frames, without a progress bar."""
    return frames


def watched(what: str, visible: bool = True) -> Watch:
    """Return a function that shows the progress over its frames, for work without further figures, such as drawing."""
    if not visible:
        return unwatched
    return lambda frames: follow(frames, what, console=Console(stderr=True), transient=True) if _draws() else logged(what, frames)


@contextmanager
def waiting(what: str, visible: bool = True) -> Iterator[None]:
    """Show that work of unknown duration is in progress."""
    if not visible:
        yield
    elif _draws():
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
    if _draws():
        with Bar(*columns, console=Console(stderr=True), transient=True) as bar:
            task = bar.add_task(doing, total=total)
            yield lambda done, doing: bar.update(task, completed=done, description=doing)
    else:
        with ProgressLog("steps") as log:
            log.begin(doing)
            yield lambda done, doing: log.move(done, total, f"next {doing}" if done < total else "")


@contextmanager
def progress_bar(visible: bool = True, done: int = 0) -> Iterator[Callable[[Progress], None]]:
    """Yield a function that takes each frame's progress and shows it on standard error.

    Args:
        visible: whether to show it; if False, the function does nothing.
        done: number of frames that are done already.
    """
    lost = 0
    with _frames_bar("tracking", visible, done) as show_frame:

        def show(progress: Progress) -> None:
            nonlocal lost
            lost += progress.lost
            figures = f"ESS {progress.ess:.0f}  survival {progress.survival_rate:.2f}"
            show_frame(progress, figures, f"{lost} lost" if lost else "")

        yield show


@contextmanager
def smoothing_bar(visible: bool = True, done: int = 0) -> Iterator[Callable[[SmoothProgress], None]]:
    """Yield a function that shows the progress of a smoother on standard error. The arguments are those of `progress_bar`."""
    with _frames_bar("smoothing", visible, done) as show_frame:
        yield lambda progress: show_frame(progress, f"{progress.distinct} distinct states", "")


type ShowFrame = Callable[[Progress | SmoothProgress, str, str], None]


@contextmanager
def _frames_bar(what: str, visible: bool, done: int) -> Iterator[ShowFrame]:
    """Yield a function of a frame's progress, its figures, and what is wrong."""
    if not visible:
        yield lambda progress, figures, wrong: None
    elif _draws():
        columns = (TextColumn("frame"), MofNCompleteColumn(), BarColumn(), TextColumn("{task.fields[figures]}  left"), TimeRemainingColumn())
        with Bar(*columns, TextColumn("[yellow]{task.fields[wrong]}"), console=Console(stderr=True)) as bar:
            task = bar.add_task("", total=None, completed=done, figures=COMPILING, wrong="")

            def draw(progress: Progress | SmoothProgress, figures: str, wrong: str) -> None:
                figures = f"{progress.seconds_per_frame:.2f} s/frame  {figures}"
                bar.update(task, completed=progress.frame, total=progress.frames, figures=figures, wrong=wrong)

            yield draw
    else:
        with ProgressLog(what, "frame") as log:
            log.begin(COMPILING)

            def say(progress: Progress | SmoothProgress, figures: str, wrong: str) -> None:
                step_s = progress.seconds_per_frame
                words = [f"{step_s:.2f} s/frame", *figures.split("  "), *([wrong] if wrong else [])]
                log.move(progress.frame, progress.frames, ", ".join(words), step_s)

            yield say


def _draws() -> bool:
    """Whether a bar can be drawn."""
    return sys.stderr.isatty() or Console(stderr=True).is_jupyter
