"""`bayes-body overlay`: the video of several people of one recording."""

from pathlib import Path

import typer

from bayes_body.base.errors import input_error
from bayes_body.cli.plugin_option import Plugins, own_terms
from bayes_body.cli.terminal import say


def overlay(
    runs: list[Path] = typer.Argument(help="Folders of the runs of two or more people of one recording."),
    out: Path | None = typer.Option(None, "--out", help="The video, .mp4; overlay.mp4 in the folder that holds the runs by default."),
    overwrite: bool = typer.Option(False, "--overwrite", help="Replace an existing file that --out names."),
    plugin: Plugins = None,
) -> None:
    """Write a video and stills with all people in one picture: each in a colour, with the name near the head.

    The stills are in a folder beside the video. The overlay of a single run is made by `track`.
    """
    from bayes_body.base.config import configure

    configure()
    from bayes_body.base.files.atomic import check_free
    from bayes_body.base.progress import watched
    from bayes_body.results.storage.names import OVERLAY_FILE
    from bayes_body.view.overlay_people import draw_people
    from bayes_body.view.people import open_people

    if out is not None:
        if out.suffix.lower() != ".mp4":
            raise input_error("--out", f"{out}", "a file with the suffix .mp4", "give it this suffix")
        check_free(out, overwrite)
    with own_terms(plugin), open_people(runs) as people:
        path, *stills = draw_people(people, out or people.folder / OVERLAY_FILE, watched("overlay"))
        missing = people.missing
    if missing:
        say(f"note: {missing}")
    say(f"{path}: {path.stat().st_size / 1e6:.1f} MB; {len(stills)} stills in {path.with_suffix('')}.")
