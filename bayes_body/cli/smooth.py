"""`bayes-body smooth`: paths through all frames of a run, given all its images."""

from pathlib import Path

import typer

from bayes_body.base.errors import input_error
from bayes_body.cli.plugin_option import Plugins, own_terms
from bayes_body.cli.terminal import say
from bayes_body.cli.track import check_range
from bayes_body.runs.limits import LARGEST_SEED


def smooth(
    run: Path = typer.Argument(help="Folder of a run made by `bayes-body track`."),
    out: Path | None = typer.Option(None, "--out", help="Folder for the smoothed run; by default RUN_smoothed, or the next free RUN_smoothed_2 ..."),
    draws: int | None = typer.Option(None, "--draws", help="Paths of each run of the filter, 250 by default."),
    moves: int | None = typer.Option(
        None,
        "--moves",
        help="Markov moves of each state, 1 by default, 0 for runs of the kernel laplace; with 0 no images are read. Not with --start joint.",
    ),
    start: str | None = typer.Option(
        None,
        "--start",
        help="How paths go back before they move: `ensemble` (the default), `gaussian` (the default for runs of the kernel laplace), or `particles`, "
        "which is exact for small models only; or `joint`: from one Gaussian of all frames at once, without moves.",
    ),
    seed: int | None = typer.Option(None, "--seed", help="Seed of everything random, 0 by default."),
    resume: bool = typer.Option(False, "--resume", help="Continue the smoothed run in --out."),
    no_pictures: bool = typer.Option(False, "--no-pictures", help="Leave out overlay.mp4 and the stills; --resume without this option draws them."),
    plugin: Plugins = None,
) -> None:
    """Smooth a run: a filter's frame knows only the images up to it, a smoothed one knows all. Writes what `track` writes.

    A draw of the result is one path through all frames: the draws give velocities, gait events and other quantities of several frames.
    """
    from bayes_body.base.config import configure

    configure()
    from bayes_body.results.storage.names import free_folder
    from bayes_body.runs.smooth import SmoothSettings, smooth_run

    check_range("--draws", draws, 1)
    check_range("--moves", moves, 0)
    check_range("--seed", seed, 0, LARGEST_SEED)
    if start not in (None, "ensemble", "gaussian", "particles", "joint"):
        raise input_error("--start", f"'{start}'", "ensemble, gaussian, particles or joint", "give one of them")
    if resume and out is None:
        raise input_error("--resume", "no --out", "the folder of the smoothed run to continue", "name it with --out")
    resolved = run.resolve()
    folder = out or free_folder(
        run.with_name(f"{run.name}_smoothed") if run.name not in ("", "..") else resolved.with_name(f"{resolved.name}_smoothed")
    )
    options = {name: value for name, value in (("draws", draws), ("moves", moves), ("start", start)) if value is not None}
    with own_terms(plugin):
        smooth_run(SmoothSettings(run, folder, options, seed, resume, not no_pictures), show=lambda line: say(line), bar=True)
    say(f"{folder}: posterior.nc, summary.json, {'' if no_pictures else 'overlay.mp4, overlay/, '}frames/, run.toml")
