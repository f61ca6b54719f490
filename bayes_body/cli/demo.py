"""`bayes-body demo`: simulate, track and report a walk in two or three minutes."""

import os
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

from bayes_body.base.errors import input_error
from bayes_body.cli.terminal import say, show
from bayes_body.cli.track import check_range
from bayes_body.runs.limits import LARGEST_SEED

if TYPE_CHECKING:
    from bayes_body.runs.demo import Demo

FOLDER = "bayes_body_demo"
# Key of the summary, label, format.
ROWS = (
    ("error_mm_mean", "error of the 15 markers, posterior mean compared with the truth", "{:.0f} mm"),
    ("error_mm_relative", "the same, relative to the pelvis", "{:.0f} mm"),
    ("error_mm_mean_fitted_offset", "the same, with the constant offset of the two skeletons fitted", "{:.0f} mm"),
    ("coverage_90", "truth inside the 90 % intervals", "{:.0%}"),
    ("coverage_50", "truth inside the 50 % intervals", "{:.0%}"),
    ("iou_median", "overlap with the silhouettes (IoU)", "{:.2f}"),
    ("rhat_share", "fraction of angles and frames with R-hat of the two runs below 1.05", "{:.0%}"),
    ("ess_median", "effective particles, median", "{:.0f}"),
    ("frames_lost", "frames lost", "{}"),
    ("seconds_per_frame", "time per frame", "{:.2f} s"),
)


def demo(
    out: Path | None = typer.Option(None, "--out", help=f"Folder for recording and run; by default {FOLDER}, or the next free {FOLDER}_2 ..."),
    seed: int = typer.Option(0, "--seed", help="Each seed gives another person, walk, room and noise."),
    quick: bool = typer.Option(False, "--quick", help="12 frames and fewer particles: only tests whether it works."),
    long: bool = typer.Option(False, "--long", help="60 frames instead of 30."),
    open_report: bool | None = typer.Option(None, "--open/--no-open", help="Show the report in a browser; by default on a terminal with a display."),
) -> None:
    """Film a simulated walk, track it like a real recording, and compare the posterior with the truth."""
    from bayes_body.base.config import configure

    check_range("--seed", seed, 0, LARGEST_SEED)
    if quick and long:
        raise input_error("--quick", "given with --long", "one of the two", "leave one out")
    configure()
    from bayes_body.results.storage.names import free_folder
    from bayes_body.runs.demo import LONG, QUICK, SHORT, result_of
    from bayes_body.runs.demo import demo as demonstrate

    size = QUICK if quick else LONG if long else SHORT
    folder, lines = free_folder(Path(FOLDER)) if out is None else out, list[str]()
    try:
        outputs = demonstrate(folder, seed, size, say, lines.append, bar=True)
        # The result is printed first, then the lines of the run.
        say(f"result     {result_of(outputs.summary)}\n")
        _table(outputs.summary)
        say()
    finally:
        for line in lines:
            say(line)
    _list_outputs(outputs)
    if has_display() if open_report is None else open_report:
        typer.launch(outputs.report.resolve().as_uri())


def has_display() -> bool:
    """Whether somebody sits in front of a terminal on a desktop."""
    is_desktop = sys.platform in ("darwin", "win32") or any(os.environ.get(name) for name in ("DISPLAY", "WAYLAND_DISPLAY"))
    return sys.stdout.isatty() and is_desktop and not any(os.environ.get(name) for name in ("CI", "SSH_CONNECTION"))


def _table(summary: dict[str, Any]) -> None:
    from rich.table import Table

    table = Table("figure", "value", box=None, pad_edge=False)
    for key, wording, form in ROWS:
        table.add_row(wording, "-" if summary[key] is None else form.format(summary[key]))
    show(table)


def _list_outputs(outputs: "Demo") -> None:
    say()
    for kind, path in (("overlay", outputs.overlay), ("report", outputs.report), ("posterior", outputs.posterior), ("recording", outputs.recording)):
        say(f"{kind:<11}{path}")
    say(f'open the report in a browser; in Python: xarray.open_datatree("{outputs.posterior}")')
