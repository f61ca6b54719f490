"""`bayes-body track`: a session and a model make a run."""

import sys
from pathlib import Path

import typer


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
    from bayes_body.run import Settings, run

    overrides = {"particles": particles, "layers": layers}
    settings = Settings(session, model, kernel, {k: v for k, v in overrides.items() if v is not None}, runs, frames, seed, out)
    summary = run(settings, show=lambda line: typer.echo(line), bar=sys.stderr.isatty())
    typer.echo(f"{out}: posterior.nc, summary.json, overlay.mp4, overlay/, run.toml")
    if summary["frames_lost"]:
        typer.secho(f"{summary['frames_lost']} of {summary['frames']} frames were lost: no particle explained them; raise --particles.", fg="yellow")
