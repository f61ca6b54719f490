"""`bayes-body import`: a laboratory's files become a session."""

from pathlib import Path

import typer

from bayes_body.errors import wrong

app = typer.Typer(help="Make a session from a laboratory's files.", no_args_is_help=True)


@app.callback()
def _group() -> None:
    """Keeps `parsec` a sub-command while it is the only one."""


@app.command()
def parsec(
    source: Path = typer.Argument(help="Folder of the PARSEC suite's bodytrack: CALIB, CAM1.., FG1.., BodyShapeParameters.txt, InitialPose.txt."),
    session: Path = typer.Argument(help="Folder to write session.toml and check.png into."),
    overwrite: bool = typer.Option(False, "--overwrite", help="Replace a session.toml that is there already, with what was edited in it."),
) -> None:
    """Cameras, images, masks, body shape and initial pose of the PARSEC suite's bodytrack."""
    from bayes_body.recording.parsec import import_parsec
    from bayes_body.session import FILE_NAME

    if (session / FILE_NAME).exists() and not overwrite:
        raise wrong(session, f"holds a {FILE_NAME} already", "a folder without one", "name another, or replace it with --overwrite")
    recording, remarks = import_parsec(source, session)
    for remark in remarks:
        typer.echo(f"note: {remark}")
    from bayes_body.config import configure

    configure()
    from bayes_body.model import load_model
    from bayes_body.view.rig_check import draw_check

    picture = draw_check(recording, load_model("deutscher_apf", recording), session / "check.png")
    typer.echo(f"{len(recording.views)} cameras, {recording.frames} frames at {recording.fps:g} frames a second: {session / 'session.toml'}")
    typer.echo(f"Look at {picture}: the body should cover the person in every view, and the axes should stand where the world's origin is.")
