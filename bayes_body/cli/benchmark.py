"""`bayes-body benchmark`: compare every kernel on every definition."""

import json
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

from bayes_body.base.errors import input_error
from bayes_body.cli.plugin_option import Plugins, own_terms
from bayes_body.cli.terminal import say, show
from bayes_body.cli.track import check_range

if TYPE_CHECKING:
    from bayes_body.workshop.compare import Pair, Row, Settings

# Columns of the table: heading, the row's key, format.
COLUMNS = (
    ("s/frame", "seconds_per_frame", ".3f"),
    ("ESS/s", "ess_per_second", ",.0f"),
    ("error mm", "error_mm_mean", ".0f"),
    ("relative mm", "error_mm_relative", ".0f"),
    ("coverage of 90 %", "coverage_90", ".2f"),
    ("calibration error", "ece_radial", ".2f"),
    ("CRPS mm", "crps_mm", ".0f"),
    ("log evidence", "log_evidence", ",.1f"),
    ("lost", "frames_lost", "d"),
)


def benchmark(
    out: Path | None = typer.Option(None, "--json", help="File for the rows; rows that it already has with the same settings are kept."),
    quick: bool = typer.Option(False, "--quick", help="5 frames and at most 200 particles: only tests whether everything runs."),
    session: Path | None = typer.Option(None, "--session", help="Folder of a session to use for all pairs; by default scenes are simulated."),
    model: list[str] | None = typer.Option(None, "--model", help="Only this definition, a name or a path; may be given more than once."),
    kernel: list[str] | None = typer.Option(None, "--kernel", help="Only this kernel; may be given more than once."),
    frames: int | None = typer.Option(None, "--frames", help="Frames of each run, 60 by default."),
    seed: int = typer.Option(0, "--seed", help="Seed of everything random."),
    plugin: Plugins = None,
) -> None:
    """Run each kernel on each model and show seconds per frame, ESS per second, errors, coverage and evidence, or why a pair cannot run."""
    from dataclasses import replace

    from bayes_body.base.config import configure

    configure()
    from bayes_body.recording.session.read import load_session
    from bayes_body.workshop.compare import Settings, pairs
    from bayes_body.workshop.compare.benchmark import QUICK

    check_range("--frames", frames, 1)
    if session is not None:
        load_session(session)
    settings = replace(QUICK if quick else Settings(), seed=seed, session=session)
    settings = settings if frames is None else replace(settings, frames=frames)
    with own_terms(plugin):
        asked = pairs(model or (), kernel or ())
        rows = _made(asked, settings, out)
    _show(rows)
    if any(row["error"] for row in rows):
        raise typer.Exit(1)


def _made(asked: "tuple[Pair, ...]", settings: "Settings", out: Path | None) -> "list[Row]":
    """Return all rows; each is written to the file as soon as it is computed."""
    from bayes_body.base.progress import steps_bar
    from bayes_body.workshop.compare import benchmark_rows

    rows_by_pair = _stored_rows(out)
    rows: list[Row] = []
    with tempfile.TemporaryDirectory(prefix="bayes-body-benchmark-") as folder, steps_bar(len(asked), _named(asked[0])) as progress:
        for number, row in enumerate(benchmark_rows(asked, settings, Path(folder), list(rows_by_pair.values())), 1):
            rows.append(row)
            rows_by_pair[row["model"], row["kernel"]] = row
            _write(out, list(rows_by_pair.values()))
            progress(number, _named(asked[min(number, len(asked) - 1)]))
    return rows


def _named(pair: "Pair") -> str:
    return f"{Path(pair.model).stem} × {pair.kernel}"


def _stored_rows(out: Path | None) -> "dict[tuple[Any, Any], Row]":
    """Return the rows that are already in the file, by model and kernel."""
    if out is None or not out.exists():
        return {}
    try:
        rows = json.loads(out.read_text(encoding="utf-8"))["rows"]
        return {(row["model"], row["kernel"]): row for row in rows}
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise input_error(out, f"cannot be read ({type(error).__name__})", "rows written by this command", "name another file with --json") from None


def _write(out: Path | None, rows: "list[Row]") -> None:
    from bayes_body.base.files.atomic import write_text

    if out is not None:
        write_text(out, json.dumps({"rows": rows}, indent=2) + "\n")


def _show(rows: "list[Row]") -> None:
    from rich.table import Table

    table = Table("model", "kernel", "data", box=None, pad_edge=False)
    for heading, _, _ in COLUMNS:
        table.add_column(heading, justify="right")
    for row in rows:
        if row["why_not"] is None and row["error"] is None:
            table.add_row(Path(row["model"]).stem, row["kernel"], row["scene"], *(_cell(row[key], form) for _, key, form in COLUMNS))
    if table.row_count:
        show(table)
    for row in rows:
        said = row["why_not"] or (f"an internal error, {row['error']}; this is a bug in the program" if row["error"] else None)
        if said:
            say(f"{Path(row['model']).stem} × {row['kernel']}: {said}")


def _cell(value: float | int | None, form: str) -> str:
    return "-" if value is None else f"{value:{form}}"
