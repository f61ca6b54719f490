"""`bayes-body report`: write a run's report as one HTML page."""

from pathlib import Path

import typer

from bayes_body.cli.plugin_option import Plugins, own_terms
from bayes_body.cli.terminal import say


def report(
    runs: list[Path] = typer.Argument(help="Folder of a run made by `bayes-body track`; or those of several people of one recording, on one page."),
    out: Path | None = typer.Option(None, "--out", help="The file; report.html in the run's folder by default, people.html for several people."),
    overwrite: bool = typer.Option(False, "--overwrite", help="Replace an existing file even if it is not a report of this program."),
    plugin: Plugins = None,
) -> None:
    """Write one HTML file that opens without a network: figures, pictures, joint angles, diagnostics, and how the run was made."""
    from bayes_body.base.config import configure

    configure()
    from bayes_body.base.progress import watched
    from bayes_body.results.storage.run_file import check_plugins
    from bayes_body.results.storage.saved_run import load_run
    from bayes_body.view.people import open_people
    from bayes_body.view.report import write_people_report, write_report

    with own_terms(plugin):
        if len(runs) > 1:
            with open_people(runs) as people:
                path = write_people_report(people, out, watched("report"), overwrite)
        else:
            with load_run(runs[0]) as saved:
                # Checked here, because otherwise everything that needs the model would silently be missing from the page.
                check_plugins(saved.folder, saved.plugins)
                path = write_report(saved, out, watched("report"), overwrite)
    say(f"{path}: {path.stat().st_size / 1e6:.1f} MB; open it in a browser.")
