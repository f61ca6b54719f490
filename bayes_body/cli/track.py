"""`bayes-body track`: a session and a model make a run."""

import sys
from pathlib import Path

import typer

from bayes_body.errors import wrong

# What a key of JAX is made from without 64-bit arrays.
LARGEST_SEED = 2**32 - 1


def track(
    session: Path = typer.Argument(help="Folder of a session, as `bayes-body import` makes it."),
    out: Path = typer.Option(..., "--out", help="Folder for the run; it must not hold another."),
    model: str = typer.Option("deutscher_apf", "--model", help="A definition's name (`bayes-body models`) or the path of your own."),
    kernel: str | None = typer.Option(
        None, "--kernel", help="annealed (a mode seeker: finds the pose, its spread is no uncertainty) or sir; the model's own by default."
    ),
    particles: int | None = typer.Option(None, "--particles", help="Particles a run."),
    layers: int | None = typer.Option(None, "--layers", help="Annealing layers a frame (annealed only)."),
    runs: int = typer.Option(1, "--runs", help="Independent filters; two or more give an R-hat."),
    frames: int | None = typer.Option(None, "--frames", help="Only the first so many frames."),
    seed: int = typer.Option(0, "--seed", help="Seed of everything random."),
) -> None:
    """Track the person of a session; leaves run.toml, posterior.nc, summary.json, overlay.mp4 and stills."""
    from bayes_body.config import configure

    configure()
    from bayes_body.cli.models import checked_definition
    from bayes_body.run import Settings, run

    most = _frames_of(session)
    _check_range("--particles", particles, 1)
    _check_range("--layers", layers, 1)
    _check_range("--runs", runs, 1)
    _check_range("--frames", frames, 1, most)
    _check_range("--seed", seed, 0, LARGEST_SEED)
    checked_definition(model)
    overrides = {"particles": particles, "layers": layers}
    settings = Settings(session, model, kernel, {k: v for k, v in overrides.items() if v is not None}, runs, frames, seed, out)
    run(settings, show=lambda line: typer.echo(line), bar=sys.stderr.isatty())
    typer.echo(f"{out}: posterior.nc, summary.json, overlay.mp4, overlay/, run.toml")


def _frames_of(folder: Path) -> int:
    """How many frames the session has, once all its files are known to be there: a run that fails half way leaves nothing to use."""
    from bayes_body.recording.check import check_session
    from bayes_body.session import FILE_NAME, load_session

    if not folder.exists() or (folder.is_dir() and not (folder / FILE_NAME).exists()):
        found = f"no {FILE_NAME} in it" if folder.exists() else "no such folder"
        raise wrong(folder, found, "the folder of a session", "check the path, or make a session with `bayes-body import`")
    session = load_session(folder)
    check_session(session)
    return session.frames


def _check_range(option: str, value: int | None, least: int, most: int | None = None) -> None:
    if value is not None and (value < least or (most is not None and value > most)):
        raise wrong(option, str(value), f"a whole number from {least}{f' to {most}' if most is not None else ' up'}", "give another number")
