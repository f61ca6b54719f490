"""`bayes-body learn regions`: options of the likelihood `regions`, from recordings with known truth."""

from pathlib import Path

import typer

from bayes_body.cli.terminal import say
from bayes_body.cli.track import check_range


def regions(
    sessions: list[Path] = typer.Argument(help="Folders of recordings with their truth, such as those made by `bayes-body simulate`."),
    model: str = typer.Option(..., "--model", help="A definition's name or the path of your own, with the likelihood `regions`."),
    frames: int = typer.Option(5, "--frames", help="Number of evenly spaced frames of each recording."),
) -> None:
    """Learn `inside`, `band` and `edge_elsewhere` of the likelihood `regions`, and print them."""
    from bayes_body.base.config import configure

    configure()
    from bayes_body.cli.models import checked_definition
    from bayes_body.recording.session.read import load_session
    from bayes_body.workshop.learning.regions import region_statistics, region_sums

    check_range("--frames", frames, 1)
    definition, everything = checked_definition(model), []
    for path in sessions:
        sums = list(region_sums(load_session(path), definition, frames))
        stats = region_statistics(sums)
        everything += sums
        say(f"# {path.name}: inside {stats.inside:.3f}, band {stats.band:.3f}, E² on sides {stats.on_sides:.2f}, nearby {stats.nearby:.2f}")
    stats = region_statistics(everything)
    say(f"[likelihood.observation]\ninside = {stats.inside:.2f}\nband = {stats.band:.2f}\nedge_elsewhere = {stats.edge_elsewhere:.2f}")
