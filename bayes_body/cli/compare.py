"""`bayes-body compare`: models and priors by their evidence."""

import re
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

from bayes_body.base.errors import input_error
from bayes_body.cli.plugin_option import Plugins, own_terms
from bayes_body.cli.terminal import say, show

if TYPE_CHECKING:
    from bayes_body.results.evidence.comparison import Comparison
    from bayes_body.runs.window_comparison import WindowComparison

# What --out gets; the picture with the suffix of its format.
JSON, PICTURE = "comparison.json", "comparison.png"
RUNS = 3


def compare(
    paths: list[Path] = typer.Argument(help="Folders of finished runs of one session by two or more models; or a session, with --model."),
    model: list[str] | None = typer.Option(None, "--model", help="With a session: a model to track it with, a name or a path; twice or more."),
    runs: int | None = typer.Option(None, "--runs", help=f"With a session: independent runs of each model, {RUNS} by default."),
    frames: int | None = typer.Option(None, "--frames", help="With a session: number of frames; all by default."),
    kernel: str | None = typer.Option(None, "--kernel", help="With a session: a kernel for all models; by default each model's own."),
    particles: int | None = typer.Option(None, "--particles", help="With a session: particles of a run; by default each model's own."),
    seed: int = typer.Option(0, "--seed", help="With a session: seed of the first run; the next ones count on from it. Also of --window."),
    window: str | None = typer.Option(
        None, "--window", metavar="FIRST-LAST", help="Also estimate these frames' evidence by NUTS and bridge sampling: where runs disagree."
    ),
    out: Path | None = typer.Option(None, "--out", help=f"Folder for {JSON} and {PICTURE}; with a session also for its runs, and then needed."),
    plugin: Plugins = None,
) -> None:
    """Compare models and priors by evidence: a table in nats, a sentence, and the difference over the frames. Runs of one model count together.

    Evidence compares priors only for the same images and the same likelihood. Runs of other frames, sessions or likelihoods are refused.
    """
    from bayes_body.base.config import configure

    configure()
    tracking = {"--runs": runs, "--frames": frames, "--kernel": kernel, "--particles": particles}
    folders = paths
    if model:
        folders = _tracked(paths, model, out, {name.removeprefix("--"): value for name, value in tracking.items()} | {"seed": seed}, plugin)
    else:
        _check_runs(paths, tracking)
    with own_terms(plugin):
        _report(folders, out, None if window is None else _frames_of(window), seed)


def _check_runs(paths: list[Path], tracking: dict[str, Any]) -> None:
    """Refuse a session without models, a single run, and options of tracking.

    Raises:
        InputError: there is one of them.
    """
    sessions = [path for path in paths if (path / "session.toml").is_file() and not (path / "run.toml").exists()]
    if sessions:
        raise input_error(sessions[0], "a session, without --model", "models to track it with", "add --model twice or more, or name finished runs")
    unused = [name for name, value in tracking.items() if value is not None]
    if unused:
        raise input_error(unused[0], "given with finished runs", "it with a session and --model", "leave it out")
    if len(paths) < 2:
        raise input_error("the runs", f"{len(paths)}", "two or more", "name runs of another model too")


def _tracked(paths: list[Path], models: list[str], out: Path | None, options: dict[str, Any], plugin: list[Path] | None) -> list[Path]:
    """Track a session with each model as a study does, or go on with it, and return the folders of the runs.

    Raises:
        InputError: no session, one model, no folder, or options that are wrong.
    """
    from bayes_body.base.toml.read import validate
    from bayes_body.cli.track import session_in
    from bayes_body.runs.study.study import run_study
    from bayes_body.runs.study.study_file import StudyFile, absolute
    from bayes_body.runs.study.units import units_of

    if len(paths) > 1:
        raise input_error("--model", f"with {len(paths)} folders", "one session", "name the session alone, or leave out --model to compare runs")
    if len(models) < 2:
        raise input_error("--model", "one model", "two or more to compare", "add another --model")
    if out is None:
        raise input_error("--out", "missing", "a folder for the runs", "add it, such as --out comparison")
    session = session_in(paths[0]).folder
    table = {name: value for name, value in options.items() if value is not None and name != "runs"}
    variants = [{"name": Path(name).stem, "model": name} for name in models]
    chosen = {"sessions": [str(session)], "variant": variants, "runs": options["runs"] or RUNS, "steps": [], "pictures": False}
    described = absolute(validate(StudyFile, table | chosen | {"plugins": [str(file) for file in plugin or ()]}, "bayes-body compare"), Path.cwd())
    if not run_study(described, out, say, bar=True):
        raise typer.Exit(1)
    return [unit.folder for unit in units_of(described, out.resolve()) if not unit.is_closing]


def _frames_of(text: str) -> tuple[int, int]:
    """Return the first and the last frame of a window.

    Raises:
        InputError: the text is none.
    """
    match = re.fullmatch(r"(\d{1,9})-(\d{1,9})", text)
    if match is None:
        raise input_error("--window", text, "its first and its last frame", "write it like 12-19")
    return int(match[1]), int(match[2])


def _report(folders: list[Path], out: Path | None, window: tuple[int, int] | None, seed: int) -> None:
    """Print the comparison, and write it if there is a folder for it."""
    import json

    from bayes_body.base.files.atomic import make_folder, write_text
    from bayes_body.base.progress import watched
    from bayes_body.results.evidence.candidates import candidates_of
    from bayes_body.results.evidence.comparison import compare, figures, remarks, verdict
    from bayes_body.view.evidence import write_comparison

    candidates, recording = candidates_of(folders)
    comparison = compare(candidates, recording)
    _show(comparison)
    say(verdict(comparison))
    for remark in remarks(comparison):
        say(f"note: {remark}")
    document = figures(comparison)
    if window is not None:
        from bayes_body.runs.window_comparison import compare_on_window, window_figures, window_verdict

        on_window = compare_on_window(candidates, recording, *window, seed, watched("windows"))
        _show_window(on_window)
        say(window_verdict(on_window))
        document["window"] = window_figures(on_window)
    if out is not None:
        write_text(make_folder(out) / JSON, json.dumps(document, indent=2) + "\n")
        write_comparison(comparison, out / PICTURE)
        say(f"{out}: {JSON}, {PICTURE}")


def _show(comparison: "Comparison") -> None:
    from rich.table import Table

    table = Table("model", "kernel", box=None, pad_edge=False)
    for heading in ("runs", "log-evidence, nats", "sd over runs", "a frame", "difference to the best"):
        table.add_column(heading, justify="right")
    for place, (candidate, evidence, lead) in enumerate(zip(comparison.candidates, comparison.estimates, comparison.differences, strict=True)):
        value, error = evidence.value[-1], evidence.error[-1]
        cells = [f"{evidence.runs}", _with_error(value, error), _cell(evidence.sd[-1]), _cell(value / comparison.frames, 2)]
        table.add_row(candidate.name, candidate.kernel, *cells, _with_error(lead.value[-1], lead.error[-1]) if place else "-")
    show(table)


def _show_window(comparison: "WindowComparison") -> None:
    from rich.table import Table

    table = Table("model", box=None, pad_edge=False)
    for heading in ("filters, nats", "by bridge sampling", "R-hat", "divergences"):
        table.add_column(heading, justify="right")
    for row in comparison.rows:
        filters = _with_error(row.filters.value[-1], row.filters.error[-1])
        table.add_row(row.name, filters, _with_error(row.value, row.error, 2), _cell(row.r_hat, 3), f"{row.divergent}")
    say()
    show(table)


def _cell(value: float, digits: int = 1) -> str:
    import numpy as np

    return f"{value:,.{digits}f}" if np.isfinite(value) else "-" if np.isnan(value) else f"{value}"


def _with_error(value: float, error: float, digits: int = 1) -> str:
    import numpy as np

    return f"{_cell(value, digits)} ± {_cell(error, digits)}" if not np.isnan(error) else _cell(value, digits)
