"""`bayes-body people`: who is in a recording."""

import sys
from pathlib import Path

import typer

from bayes_body.cli.terminal import say


def people(
    session: Path = typer.Argument(help="Folder of a session whose keypoint files have several people, made by `bayes-body import`."),
) -> None:
    """List the people of a recording: when and where they are seen; makes for everyone a session with a picture, which `track --person` tracks."""
    from bayes_body.cli.track import session_in
    from bayes_body.runs.people import make_people

    folder = session_in(session).folder
    folders = make_people(folder, say, sys.stderr.isatty())
    say(f"Look at {folders[0].parent}/person_*/picture.png; `bayes-body track {session} --person 2` tracks person 2, --person all everyone.")
