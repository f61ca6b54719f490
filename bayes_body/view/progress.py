"""The bar of a run: frames, seconds a frame, ESS, survival rate, time left."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, TextColumn, TimeRemainingColumn
from rich.progress import Progress as Bar
from rich.progress import track as follow

from bayes_body.tracking.track import Progress

type Watch = Callable[[Sequence[int]], Iterable[int]]


def unwatched(frames: Sequence[int]) -> Iterable[int]:
    """The frames, without a bar."""
    return frames


def watched(what: str, visible: bool = True) -> Watch:
    """A bar over the frames that it is given, for work without figures of its own, such as drawing."""
    return lambda frames: follow(frames, what, console=Console(stderr=True), disable=not visible, transient=True)


@contextmanager
def waiting(what: str, visible: bool = True) -> Iterator[None]:
    """A sign that something is at work whose length is not known."""
    if not visible:
        yield
        return
    with Console(stderr=True).status(what):
        yield


@contextmanager
def progress_bar(visible: bool = True, done: int = 0) -> Iterator[Callable[[Progress], None]]:
    """A function that takes each frame's progress, drawn on standard error; with `visible` false it draws nothing.

    Args:
        visible: whether it draws.
        done: how many frames are there already.
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
