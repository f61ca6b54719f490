"""`bayes-body demo`: simulate, track and report a walk in a few minutes."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

from bayes_body.cli.terminal import say, show
from bayes_body.cli.track import LARGEST_SEED, check_range

if TYPE_CHECKING:
    from bayes_body.demo import Demo

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
    quick: bool = typer.Option(False, "--quick", help="A fifth of the frames and fewer particles: only tests whether it works."),
) -> None:
    """Film a simulated walk, track it like a real recording, and compare the posterior with the truth."""
    from bayes_body.config import configure

    check_range("--seed", seed, 0, LARGEST_SEED)
    configure()
    from bayes_body.demo import QUICK, WHOLE, result_of
    from bayes_body.demo import demo as demonstrate
    from bayes_body.storage.names import free_folder

    folder, lines = free_folder(Path(FOLDER)) if out is None else out, list[str]()
    try:
        found = demonstrate(folder, seed, QUICK if quick else WHOLE, say, lines.append, bar=True)
        # The result is printed first, then the lines of the run.
        say(f"result     {result_of(found.summary)}\n")
        _table(found.summary)
        say()
    finally:
        for line in lines:
            say(line)
    _where(found)


def _table(summary: dict[str, Any]) -> None:
    from rich.table import Table

    table = Table("figure", "value", box=None, pad_edge=False)
    for key, what, form in ROWS:
        table.add_row(what, "-" if summary[key] is None else form.format(summary[key]))
    show(table)


def _where(found: "Demo") -> None:
    say()
    for what, path in (("overlay", found.overlay), ("report", found.report), ("posterior", found.posterior), ("recording", found.recording)):
        say(f"{what:<11}{path}")
    say(f'open the report in a browser; in Python: xarray.open_datatree("{found.posterior}")')
