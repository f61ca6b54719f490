"""`bayes-body combine`: the independent runs of a session as one run."""

from pathlib import Path

import typer

from bayes_body.cli.plugin_option import Plugins, own_terms
from bayes_body.cli.terminal import say
from bayes_body.cli.track import draws_of


def combine(
    runs: list[Path] = typer.Argument(help="Folders of two or more runs of one session, made with the same options and different --seed."),
    out: Path = typer.Option(..., "--out", help="Folder for the runs together; it is made anew if it has others."),
    keep: str | None = typer.Option(
        None,
        "--keep",
        metavar="draws=N",
        help="Store N draws of a frame and run, 200 by default, or `all`; diagnostics are computed from all. Smoothed runs are stored whole.",
    ),
    no_pictures: bool = typer.Option(False, "--no-pictures", help="Leave out overlay.mp4 and the stills; the same command without it draws them."),
    plugin: Plugins = None,
) -> None:
    """Put independent runs of a session together as the chains of one run: R-hat, one report, one export. Writes what `track` writes.

    The runs stay as they are. They may be those of a filter, or smoothed ones.
    """
    from bayes_body.base.config import configure

    configure()
    from bayes_body.runs.study.combine import DRAWS, combine_runs

    draws = DRAWS if keep is None else None if keep == "all" else draws_of(keep)
    with own_terms(plugin):
        combine_runs(runs, out, lambda line: say(line), True, draws, not no_pictures)
    say(f"{out}: posterior.nc, summary.json, {'' if no_pictures else 'overlay.mp4, overlay/, '}frames/, run.toml")
