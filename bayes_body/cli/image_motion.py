"""`bayes-body learn image-motion`: options of the likelihood `image_motion`, from recordings with known truth."""

from pathlib import Path

import typer

from bayes_body.cli.terminal import say
from bayes_body.cli.track import check_range


def image_motion(
    sessions: list[Path] = typer.Argument(help="Folders of recordings with their truth, such as those made by `bayes-body simulate`."),
    model: str = typer.Option(..., "--model", help="A definition's name or the path of your own, with the likelihood `image_motion`."),
    frames: int = typer.Option(10, "--frames", help="Number of evenly spaced pairs of frames of each recording."),
) -> None:
    """Learn `noise_grey`, `outlier_share` and `precision` of the likelihood `image_motion`, and print them."""
    from bayes_body.base.config import configure

    configure()
    from bayes_body.cli.models import checked_definition
    from bayes_body.recording.session.read import load_session
    from bayes_body.workshop.learning.image_motion import motion_noise, motion_pairs

    check_range("--frames", frames, 1)
    definition, everything = checked_definition(model), []
    for path in sessions:
        pairs = list(motion_pairs(load_session(path), definition, frames))
        noise = motion_noise(pairs)
        everything += pairs
        figures = f"noise_grey {noise.noise_grey:.2f}, outlier_share {noise.outlier_share:.3f}, precision {noise.precision:.3f}"
        say(f"# {path.name}: {figures}, {sum(pair.difference.size for pair in pairs):,} points")
    noise = motion_noise(everything)
    say(f"noise_grey = {noise.noise_grey:.2f}\noutlier_share = {noise.outlier_share:.3f}\nprecision = {noise.precision:.3f}")
