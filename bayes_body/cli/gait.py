"""`bayes-body gait`: foot strikes, toe offs, strides, cadence and speed of a smoothed run, each with its uncertainty."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import typer

from bayes_body.cli.plugin_option import Plugins, own_terms
from bayes_body.cli.terminal import say, show

if TYPE_CHECKING:
    from rich.table import Table

    from bayes_body.clinical.gait_table import Row

FILE_NAME = "gait.csv"
SIDES = {"r": "right", "l": "left", "": ""}
# A quantity that fewer draws have is marked: it may be no event at all.
MOST = 0.9


def gait(
    run: Path = typer.Argument(help="Folder of a smoothed run, made by `bayes-body smooth`."),
    out: Path | None = typer.Option(None, "--out", help=f"The file; {FILE_NAME} in the run's folder by default."),
    overwrite: bool = typer.Option(False, "--overwrite", help="Replace an existing file."),
    plugin: Plugins = None,
) -> None:
    """Print when each foot strikes the floor and leaves it, and cadence, speed, stride length and time, each with a 90 % interval; write a CSV file.

    The CSV file has the single strides too. The person walks upright; events within 0.2 s of the recording's ends are not found.
    """
    from bayes_body.config import configure

    configure()
    from bayes_body.clinical.gait import POINTS, gait_of
    from bayes_body.clinical.gait_table import event_rows, walk_rows, write_gait
    from bayes_body.clinical.trajectories import marker_paths
    from bayes_body.files.atomic import make_folder
    from bayes_body.files.existing import check_free
    from bayes_body.storage.saved_run import load_run

    path = out or run / FILE_NAME
    check_free(path, overwrite)
    with own_terms(plugin), load_run(run) as saved:
        found = gait_of(marker_paths(saved, POINTS), saved.fps, "xyz".index(saved.session.up))
    make_folder(path.parent)
    write_gait(found, path)
    if not found.events:
        say("No steps were found.")
    for title, rows in (("The walk", walk_rows(found)), ("Events, s from the first frame", event_rows(found))):
        if rows:
            show(_table(title, rows))
    say(f"{path}: {len(found.events)} events, {len(found.strides)} strides.")


def _table(title: str, rows: "Sequence[Row]") -> "Table":
    from rich.table import Table

    table = Table(title=title, title_justify="left", box=None)
    for name in ("", "side", "unit"):
        table.add_column(name)
    for name in ("mean", "sd", "5 %", "95 %"):
        table.add_column(name, justify="right")
    table.add_column("")
    for row in rows:
        note = "" if row.share_of_draws >= MOST else f"in {row.share_of_draws:.0%} of the draws"
        figures = (f"{value:.3f}" if row.unit in ("s", "m", "m/s") else f"{value:.1f}" for value in (row.mean, row.sd, row.q05, row.q95))
        table.add_row(row.quantity.replace("_", " "), SIDES[row.side], row.unit, *figures, note)
    return table
