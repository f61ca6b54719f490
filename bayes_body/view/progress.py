"""The progress bar of a run: frames, seconds per frame, ESS, survival rate, time left."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, TextColumn, TimeRemainingColumn
from rich.progress import Progress as Bar
from rich.progress import track as follow

from bayes_body.tracking.smooth import SmoothProgress
from bayes_body.tracking.track import Progress

type Watch = Callable[[Sequence[int]], Iterable[int]]


def unwatched(frames: Sequence[int]) -> Iterable[int]:
    """Return the frames, without a progress bar."""
    return frames


def watched(what: str, visible: bool = True) -> Watch:
    """Return a function that shows a progress bar over its frames, for work without further figures, such as drawing."""
    return lambda frames: follow(frames, what, console=Console(stderr=True), disable=not visible, transient=True)


@contextmanager
def waiting(what: str, visible: bool = True) -> Iterator[None]:
    """Show that work of unknown duration is in progress."""
    if not visible:
        yield
        return
    with Console(stderr=True).status(what):
        yield


@contextmanager
def progress_bar(visible: bool = True, done: int = 0) -> Iterator[Callable[[Progress], None]]:
    """Yield a function that takes each frame's progress and draws the bar on standard error.

    Args:
        visible: whether to draw; if False, the function draws nothing.
        done: number of frames that are done already.
    """
    columns = (
        TextColumn("frame"),
        MofNCompleteColumn(),
        BarColumn(),
        TextColumn("{task.fields[speed]}  ESS {task.fields[ess]}  survival {task.fields[survival]}  left"),
        TimeRemainingColumn(),
        TextColumn("[yellow]{task.fields[lost]}"),
    )
    lost = 0
    with Bar(*columns, console=Console(stderr=True), disable=not visible) as bar:
        task = bar.add_task("", total=None, completed=done, speed="compiling", ess="-", survival="-", lost="")

        def show(progress: Progress) -> None:
            nonlocal lost
            lost += progress.lost
            bar.update(
                task,
                completed=progress.frame,
                total=progress.frames,
                speed=f"{progress.seconds_per_frame:.2f} s/frame",
                ess=f"{progress.ess:.0f}",
                survival=f"{progress.survival_rate:.2f}",
                lost=f"{lost} lost" if lost else "",
            )

        yield show


@contextmanager
def smoothing_bar(visible: bool = True, done: int = 0) -> Iterator[Callable[[SmoothProgress], None]]:
    """Yield a function that draws the progress of a smoother on standard error. The arguments are those of `progress_bar`."""
    columns = (TextColumn("frame"), MofNCompleteColumn(), BarColumn(), TextColumn("{task.fields[figures]}  left"), TimeRemainingColumn())
    with Bar(*columns, console=Console(stderr=True), disable=not visible) as bar:
        task = bar.add_task("", total=None, completed=done, figures="compiling")

        def show(progress: SmoothProgress) -> None:
            figures = f"{progress.seconds_per_frame:.2f} s/frame  {progress.distinct} distinct states"
            bar.update(task, completed=progress.frame, total=progress.frames, figures=figures)

        yield show
