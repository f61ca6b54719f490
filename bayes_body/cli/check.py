"""`bayes-body check`: test whether a kernel samples the posterior of a model. The exit status is 0 if it passes, 1 if it does not."""

import os
from pathlib import Path
from typing import TYPE_CHECKING

import typer

from bayes_body.base.errors import input_error
from bayes_body.cli.plugin_option import Plugins, own_terms
from bayes_body.cli.terminal import say
from bayes_body.cli.track import check_range
from bayes_body.runs.limits import LARGEST_SEED

if TYPE_CHECKING:
    from bayes_body.workshop.calibration.check import Plan

FAILED = 1
LARGEST_BINS = 200


def check(
    model: str = typer.Argument(help="A definition's name (`bayes-body models`) or the path of your own."),
    kernel: str | None = typer.Option(None, "--kernel", help="annealed, sir, tempered, laplace, hmc or particle_bp; the model's own by default."),
    replications: int = typer.Option(
        200, "--replications", help="Number of truths that are drawn and filtered; up to four times as many where the result is close."
    ),
    json_file: Path | None = typer.Option(
        None,
        "--json",
        help="File for all figures; the ranks for ArviZ are written beside it (.ranks.nc). Until the check is complete, the finished part is beside "
        "it too; the same command continues it.",
    ),
    plot: Path | None = typer.Option(None, "--plot", help="A picture of the ranks (.png, .pdf or .svg)."),
    particles: int | None = typer.Option(None, "--particles", help="Number of particles; by default a pilot finds how many are enough."),
    layers: int | None = typer.Option(None, "--layers", help="Annealing layers per frame (annealed only)."),
    move: str | None = typer.Option(None, "--move", help="hmc or random_walk (tempered only)."),
    moves: int | None = typer.Option(None, "--moves", help="Markov moves of a particle per stage (tempered only)."),
    leapfrog_steps: int | None = typer.Option(None, "--leapfrog-steps", help="Gradients that an HMC move takes (tempered only)."),
    session: Path | None = typer.Option(
        None, "--session", help="Folder of a session whose cameras, subject and first pose are used; by default a room with four cameras."
    ),
    rig: Path | None = typer.Option(None, "--rig", help="File of a rig whose cameras replace those of the room."),
    frames: int = typer.Option(2, "--frames", help="Number of frames that are filtered; the last one is tested."),
    bins: int = typer.Option(20, "--bins", help="Bins of the ranks; each needs 10 effective particles."),
    jobs: int | None = typer.Option(None, "--jobs", help="Number of processes; by default one per core."),
    seed: int = typer.Option(0, "--seed", help="Seed of everything random."),
    plugin: Plugins = None,
) -> None:
    """Check a kernel on a model: simulation-based calibration, invariance of its Markov move, coverage; or compare means with a grid quadrature."""
    from bayes_body.base.config import configure

    configure()
    from bayes_body.cli.models import checked_definition
    from bayes_body.model.kernel_options import kernel_options
    from bayes_body.workshop.calibration.check import Plan

    counts = {"particles": particles, "layers": layers, "moves": moves, "leapfrog_steps": leapfrog_steps}
    for name, value in (counts | {"frames": frames, "jobs": jobs}).items():
        check_range(f"--{name.replace('_', '-')}", value, 1)
    check_range("--replications", replications, 2)
    check_range("--bins", bins, 2, LARGEST_BINS)
    check_range("--seed", seed, 0, LARGEST_SEED)
    _check_files(json_file, plot)
    if session is not None and rig is not None:
        raise input_error("--rig", f"given together with --session {session}", "one of the two", "leave one out")
    overrides = {name: value for name, value in (counts | {"move": move}).items() if value is not None}
    folder, cameras = (None if path is None else str(path) for path in (session, rig))
    with own_terms(plugin):
        kind, options = kernel_options(checked_definition(model), kernel, overrides)
        plugins = tuple(str(path) for path in plugin or ())
        plan = Plan(model, kind, options.model_dump(), folder, cameras, frames, bins, seed=seed, plugins=plugins)
        passed = _run(plan, particles is None, replications, jobs or os.cpu_count() or 1, json_file, plot)
    if not passed:
        raise typer.Exit(FAILED)


def _run(plan: "Plan", pilot: bool, replications: int, jobs: int, json_file: Path | None, plot: Path | None) -> bool:
    """Run the check, and return whether it passed."""
    from bayes_body.workshop.calibration.report import run_and_report

    return run_and_report(plan, pilot, replications, jobs, json_file, plot, lambda line: say(line), bar=True)


def _check_files(json_file: Path | None, plot: Path | None) -> None:
    """Check that the output files can be written, before minutes of computation."""
    from bayes_body.workshop.calibration.picture import ranks_file

    ranks = None if json_file is None else ranks_file(json_file)
    for option, path in (("--json", json_file), ("--json", ranks), ("--plot", plot)):
        if path is not None and (path.is_dir() or not path.parent.is_dir()):
            problem = "a folder" if path.is_dir() else f"there is no folder {path.parent}"
            raise input_error(f"{option} {path}", problem, "a file in a folder that exists", "make the folder, or name another file")
    if plot is not None and plot.suffix not in (".png", ".pdf", ".svg"):
        raise input_error(f"--plot {plot}", f"the ending '{plot.suffix}'", ".png, .pdf or .svg", "name another file")
