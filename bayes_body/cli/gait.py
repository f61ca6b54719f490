"""`bayes-body gait`: foot strikes, toe offs, strides, cadence, speed and peak angles of a smoothed run, each with its uncertainty."""

import sys
from collections.abc import Collection, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import typer

from bayes_body.cli.plugin_option import Plugins, own_terms
from bayes_body.cli.terminal import say, show

if TYPE_CHECKING:
    from rich.table import Table

    from bayes_body.results.clinical.gait_table import Row
    from bayes_body.results.clinical.ranges import AngleRange

FILE_NAME = "gait.csv"
SIDES = {"r": "right", "l": "left", "": ""}
# A quantity that fewer draws have is marked: it may be no event at all.
MOST = 0.9
# An angle that the images do not determine shows what the motion prior expects.
NOT_DETERMINED = "not determined: as wide as the motion prior"
# The angles that are printed, and the most events; the file has all.
LEGS, MOST_ROWS = ("pelvic", "hip", "knee", "ankle"), 100


def gait(
    run: Path = typer.Argument(help="Folder of a smoothed run, made by `bayes-body smooth`."),
    out: Path | None = typer.Option(None, "--out", help=f"The file; {FILE_NAME} in the run's folder by default."),
    overwrite: bool = typer.Option(False, "--overwrite", help="Replace an existing file."),
    plugin: Plugins = None,
) -> None:
    """Print foot strikes and toe offs, cadence, speed, strides, and peaks and ranges of the legs' angles, with 90 % intervals; write a CSV file.

    The CSV file has the single strides and all angles too. The person walks upright; events within 0.2 s of the recording's ends are not found.
    """
    from bayes_body.base.config import configure

    configure()
    from bayes_body.base.files.atomic import check_free, make_folder
    from bayes_body.base.progress import waiting
    from bayes_body.results.clinical.determined import undetermined_angles
    from bayes_body.results.clinical.gait import POINTS, gait_of
    from bayes_body.results.clinical.gait_table import event_rows, walk_rows, write_gait
    from bayes_body.results.clinical.paths import sd_path
    from bayes_body.results.clinical.ranges import ranges_of, stride_ranges
    from bayes_body.results.clinical.trajectories import angle_paths, marker_paths
    from bayes_body.results.storage.saved_run import load_run

    path = out or run / FILE_NAME
    check_free(path, overwrite)
    with own_terms(plugin), load_run(run) as saved:
        up = "xyz".index(saved.session.up)
        with waiting("gait", sys.stderr.isatty()):
            walk = gait_of(marker_paths(saved, POINTS), saved.fps, up)
            angles = angle_paths(saved.tree, saved.model, up, saved.fps)
            undetermined = undetermined_angles(saved.model, up, angles.labels, sd_path(angles.degrees))
            ranges = [*ranges_of(angles), *stride_ranges(angles, walk, saved.fps)]
    make_folder(path.parent)
    write_gait(walk, path, ranges)
    if not walk.events:
        say("No steps were found.")
    for title, rows in (("The walk", walk_rows(walk)), ("Events, s from the first frame", event_rows(walk))):
        if rows:
            show(_table(title, rows[:MOST_ROWS]))
        if len(rows) > MOST_ROWS:
            say(f"... and {len(rows) - MOST_ROWS} more events: {path} has all.")
    legs = [angle_range for angle_range in ranges if not angle_range.stride and angle_range.name.startswith(LEGS)]
    if legs:
        show(_angle_table("Angles of the legs over the recording, degrees, with 90 % intervals", legs, undetermined))
    say(f"{path}: {len(walk.events)} events, {len(walk.strides)} strides, {len(angles.names)} angles.")


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


def _angle_table(title: str, ranges: "Sequence[AngleRange]", undetermined: Collection[str]) -> "Table":
    from rich.table import Table

    from bayes_body.results.clinical.gait_table import angle_rows

    table = Table(title=title, title_justify="left", box=None)
    for name in ("", "side"):
        table.add_column(name)
    for name in ("largest", "smallest", "range"):
        table.add_column(name, justify="right")
    table.add_column("")
    for angle_range in ranges:
        # Adding 0 turns -0 into 0.
        figures = (f"{round(row.mean, 1) + 0:.1f} ({round(row.q05, 1) + 0:.1f} to {round(row.q95, 1) + 0:.1f})" for row in angle_rows([angle_range]))
        note = NOT_DETERMINED if angle_range.label in undetermined else ""
        table.add_row(angle_range.name.replace("_", " "), SIDES[angle_range.side], *figures, note)
    return table
