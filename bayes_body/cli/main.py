"""`bayes-body`: the commands. Each fault in an input is reported in one sentence on standard error, with exit status 2 and without a traceback."""

import os
import sys
import tempfile
import traceback
from collections.abc import Sequence
from pathlib import Path

import typer

from bayes_body import __version__
from bayes_body.cli import benchmark, check, demo, export, import_, learn, mocap, models, report, simulate, track
from bayes_body.errors import FaultyFileError, InputError
from bayes_body.files.read import check_native

WRONG_INPUT, OUR_FAULT, INTERRUPTED = 2, 1, 130

app = typer.Typer(
    help="Bayesian 3D human pose and motion, with honest uncertainty, from calibrated video.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode="rich",
)
app.command("demo")(demo.demo)
app.add_typer(import_.app, name="import")
app.command("track")(track.track)
app.command("report")(report.report)
app.command("export")(export.export)
app.command("simulate")(simulate.simulate)
app.command("mocap")(mocap.mocap)
app.command("check")(check.check)
app.command("benchmark")(benchmark.benchmark)
app.add_typer(learn.app, name="learn")
app.add_typer(models.app, name="models")


@app.callback(invoke_without_command=True)
def _common(version: bool = typer.Option(False, "--version", help="Print the version and exit.")) -> None:
    if version:
        typer.echo(f"bayes-body {__version__}")
        raise typer.Exit


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the command line and exit with its status."""
    try:
        # Libraries that read and write files would crash on other paths, some of them after hours of tracking.
        for argument in (".", *(sys.argv[1:] if arguments is None else arguments)):
            check_native(Path(argument))
        app(args=list(arguments) if arguments is not None else None)
    except InputError as error:
        for sentence in error.sentences if isinstance(error, FaultyFileError) else [str(error)]:
            typer.secho(f"bayes-body: {sentence}", err=True, fg="red")
        sys.exit(WRONG_INPUT)
    except SystemExit as stopped:
        # On an interruption, typer exits with this status and prints nothing.
        if stopped.code == INTERRUPTED:
            typer.secho("bayes-body: interrupted.", err=True, fg="red")
        raise
    except Exception as error:
        typer.secho(f"bayes-body: {_internal(error)}", err=True, fg="red")
        sys.exit(OUR_FAULT)


def _internal(error: Exception) -> str:
    handle, path = tempfile.mkstemp(prefix="bayes-body-", suffix=".log")
    with os.fdopen(handle, "w") as log:
        log.write("".join(traceback.format_exception(error)))
    return f"an internal error, {type(error).__name__}: {error}; this is a bug in the program: report it with the details in {path}."


if __name__ == "__main__":
    main()
