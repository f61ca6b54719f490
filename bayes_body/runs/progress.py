"""The progress of a run on standard error: frames, seconds per frame, ESS, survival rate and the time left."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, TextColumn, TimeRemainingColumn
from rich.progress import Progress as Bar

from bayes_body.base.progress import ProgressLog, draws_bars
from bayes_body.tracking.smooth import SmoothProgress
from bayes_body.tracking.track import Progress

# What a run does before its first frame is there.
COMPILING = "compiling"
type ShowFrame = Callable[[Progress | SmoothProgress, str, str], None]


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


@contextmanager
def doing_line(work: str, visible: bool = True) -> Iterator[Callable[[str], None]]:
    """Yield a function that shows what is being done, for work whose steps cannot be counted before: a line that changes, or lines of a log."""
    if not visible:
        yield lambda doing: None
    elif draws_bars():
        with Console(stderr=True).status(work) as status:
            yield lambda doing: status.update(f"{work}: {doing}")
    else:
        with ProgressLog(work) as log:
            yield log.begin


@contextmanager
def _frames_bar(what: str, visible: bool, done: int) -> Iterator[ShowFrame]:
    """Yield a function of a frame's progress, its figures, and what is wrong."""
    if not visible:
        yield lambda progress, figures, wrong: None
    elif draws_bars():
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
