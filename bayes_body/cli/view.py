"""`bayes-body view`: write a run as a 3D scene in one HTML file."""

import re
import webbrowser
from pathlib import Path

import typer

from bayes_body.base.errors import input_error
from bayes_body.cli.plugin_option import Plugins, own_terms
from bayes_body.cli.terminal import say

MOST_DRAWS = 1000


def view(
    runs: list[Path] = typer.Argument(help="Folder of a run made by `bayes-body track`; or those of several people of one recording, in one scene."),
    out: Path | None = typer.Option(None, "--out", help="The file; view.html in the run's folder by default, people_3d.html for several people."),
    draws: int = typer.Option(50, "--draws", help=f"Draws from the posterior of each frame, 0 to {MOST_DRAWS}; several people share them."),
    frames: str | None = typer.Option(None, "--frames", help="First and last frame, such as 100-250, or how many, evenly spaced; all by default."),
    overwrite: bool = typer.Option(False, "--overwrite", help="Replace an existing file even if it is not a view of this program."),
    open_: bool = typer.Option(False, "--open", help="Open the file in the browser."),
    plugin: Plugins = None,
) -> None:
    """Write one HTML file that turns, zooms and plays without a network: mean body, draws, cameras with their images, truth and keypoints."""
    from bayes_body.base.config import configure

    configure()
    from bayes_body.base.progress import watched
    from bayes_body.results.storage.run_file import check_plugins
    from bayes_body.results.storage.saved_run import load_run
    from bayes_body.view.people import open_people
    from bayes_body.view.viewer import write_people_view, write_view

    if not 0 <= draws <= MOST_DRAWS:
        raise input_error("--draws", f"{draws}", f"a number from 0 to {MOST_DRAWS}", "give another number")
    with own_terms(plugin):
        if len(runs) > 1:
            with open_people(runs) as people:
                shown = chosen(frames, len(people.frames), people.frames.start)
                path, remarks = write_people_view(people, out, draws, shown, watched("view"), overwrite)
        else:
            with load_run(runs[0]) as saved:
                check_plugins(saved.folder, saved.plugins)
                shown = chosen(frames, saved.frames, saved.first_frame)
                path, remarks = write_view(saved, out, draws, shown, watched("view"), overwrite)
    for remark in remarks:
        say(remark)
    say(f"{path}: {path.stat().st_size / 1e6:.1f} MB; open it in a browser.")
    if open_ and not webbrowser.open(path.resolve().as_uri()):
        say("No browser was found: open the file yourself.")


def chosen(text: str | None, frames: int, first: int = 0) -> range:
    """Return the frames that a user names, counted from 0: `A-B`, both included, or a number of evenly spaced ones; all of them without a text.

    Args:
        text: what the user wrote.
        frames: number of frames of the run.
        first: the number by which the user knows the first one.

    Raises:
        InputError: the text has another form, or the run does not have these frames.
    """
    if text is None:
        return range(frames)
    expected = f"A-B with frames from {first} to {first + frames - 1}, or a number of frames"
    pair, number = re.fullmatch(r"(\d{1,9})-(\d{1,9})", text), re.fullmatch(r"\d{1,9}", text)
    if pair and first <= int(pair[1]) <= int(pair[2]) < first + frames:
        return range(int(pair[1]) - first, int(pair[2]) - first + 1)
    if number and int(text) > 0:
        return range(0, frames, -(-frames // int(text)))
    raise input_error("--frames", text, expected, "write for example 0-99 or 100")
