"""`bayes-body fit`: infer body lengths, cameras and keypoint offsets from a session's keypoints, and write a session with them."""

from pathlib import Path

import typer

from bayes_body.cli.plugin_option import Plugins, own_terms
from bayes_body.cli.terminal import say
from bayes_body.cli.track import check_range, free_beside, session_in
from bayes_body.runs.limits import LARGEST_SEED

# With fewer frames the errors of a network hardly differ between them.
FEWEST_FRAMES = 5


def fit(
    session: Path = typer.Argument(help="Folder of a session made by `bayes-body import`, with keypoints in two or more cameras."),
    out: Path | None = typer.Option(None, "--out", help="Folder for the new session; by default SESSION_fit, or the next free SESSION_fit_2 ..."),
    model: str | None = typer.Option(
        None,
        "--model",
        help="A definition's name (`bayes-body models`) or the path of your own, which reads keypoints; keypoints by default. Lengths, cameras and "
        "keypoint offsets become unknown, unless it has unknowns of its own.",
    ),
    frames: int | None = typer.Option(None, "--frames", help="Number of frames, 40 by default, or all of a shorter recording."),
    delays: bool = typer.Option(False, "--delays", help="Infer also how late each camera is against the first one."),
    seed: int = typer.Option(0, "--seed", help="Seed of everything random."),
    plugin: Plugins = None,
) -> None:
    """Infer body lengths, cameras and keypoint offsets from keypoints; writes a new session with them and their uncertainty, fit.json and fit.png."""
    from bayes_body.base.config import configure

    configure()
    from bayes_body.cli.models import checked_definition
    from bayes_body.runs.unknowns.fit import FRAMES, MODEL, FitSettings
    from bayes_body.runs.unknowns.fit import fit as fit_session

    recording = session_in(session)
    check_range("--frames", frames, FEWEST_FRAMES, recording.frames)
    check_range("--seed", seed, 0, LARGEST_SEED)
    folder = out or free_beside(session, "fit")
    with own_terms(plugin):
        if model is not None:
            checked_definition(model)
        fit_session(recording, FitSettings(folder, model or MODEL, frames or FRAMES, delays, seed), show=lambda line: say(line), bar=True)
    say(f"{folder}: session.toml, fit.json, fit.png")
