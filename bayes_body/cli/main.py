"""`bayes-body`: the commands. Each fault in an input is reported in one sentence on standard error, with exit status 2 and without a traceback."""

import os
import sys
import tempfile
import traceback
import warnings
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

import typer

import bayes_body
from bayes_body.base.errors import FaultyFileError, InputError, RunWarning, input_error
from bayes_body.base.files.read import check_native
from bayes_body.cli import (
    benchmark,
    check,
    combine,
    compare,
    demo,
    export,
    fit,
    gait,
    import_,
    learn,
    mocap,
    models,
    overlay,
    people,
    picture,
    report,
    simulate,
    smooth,
    status,
    study,
    track,
    view,
)
from bayes_body.cli.surroundings import STOPPED, check_current_folder, fault_of_surroundings, stoppable
from bayes_body.cli.terminal import Guarded, complain, guarded, say

WRONG_INPUT, OUR_FAULT, OUTPUT_LOST = 2, 1, 1

app = typer.Typer(
    help="Bayesian 3D human pose and motion, with honest uncertainty, from calibrated video.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    # The tables of rich take longer to import than everything else that `--help` needs.
    rich_markup_mode=None,
)
# (verb, its function or its own verbs, a line for the list of commands)
COMMANDS: tuple[tuple[str, Any, str], ...] = (
    ("demo", demo.demo, "Film a simulated walk, track it, compare with the truth."),
    ("import", import_.app, "Make a session from a laboratory's files."),
    ("people", people.people, "List who is in a recording, a session for everyone."),
    ("fit", fit.fit, "Infer lengths and cameras from keypoints."),
    ("track", track.track, "Track the person in a session."),
    ("study", study.study, "Track many sessions, on this machine or a cluster."),
    ("status", status.status, "Print how far a study is."),
    ("smooth", smooth.smooth, "Smooth a run: its frames then know the later ones, too."),
    ("combine", combine.combine, "Put independent runs of a session together."),
    ("compare", compare.compare, "Compare models and priors by their evidence."),
    ("report", report.report, "Write a run's report: one HTML file."),
    ("view", view.view, "Write a run as an HTML file that turns and plays in 3D."),
    ("overlay", overlay.overlay, "Draw several people of a recording in one video."),
    ("picture", picture.picture, "Draw a frame or the curves of a run for a paper."),
    ("export", export.export, "Write a run's motion for another program."),
    ("gait", gait.gait, "List the strides of a run, with intervals."),
    ("simulate", simulate.simulate, "Film a captured motion with simulated cameras."),
    ("mocap", mocap.mocap, "Map a captured motion to a body's joint angles."),
    ("check", check.check, "Check a kernel on a model by simulation."),
    ("benchmark", benchmark.benchmark, "Run each kernel on each model, and time them."),
    ("learn", learn.app, "Learn from captured motion or from known truth."),
    ("models", models.app, "List the model definitions, or check one."),
)
for verb, command, line in COMMANDS:
    if isinstance(command, typer.Typer):
        app.add_typer(command, name=verb, short_help=line)
    else:
        app.command(verb, short_help=line)(command)


@app.callback(invoke_without_command=True)
def _common(version: bool = typer.Option(False, "--version", help="Print the version and exit.")) -> None:
    if version:
        say(f"bayes-body {bayes_body.__version__}")
        raise typer.Exit


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the command line and exit with its status."""
    warnings.showwarning = _show_warning
    warnings.filterwarnings("once", category=RunWarning)
    with guarded() as (output, _), stoppable():
        status = _status(sys.argv[1:] if arguments is None else list(arguments))
        status = _report_lost_output(output) if output.error and not status else status
    sys.exit(status)


def _show_warning(message: Warning | str, *_: Any) -> None:
    complain(f"note: {message}")


def _status(arguments: list[str]) -> int:
    """Run a command and return its exit status."""
    try:
        check_current_folder()
        _check_given(arguments)
        # Libraries that read and write files would crash on other paths, some of them after hours of tracking.
        for argument in (".", *arguments):
            check_native(Path(argument))
        app(args=arguments)
    except SystemExit as stopped:
        if stopped.code in STOPPED:
            complain(f"{STOPPED[stopped.code]}.")
        return stopped.code if isinstance(stopped.code, int) else int(stopped.code is not None)
    except Exception as error:
        fault = error if isinstance(error, InputError) else fault_of_surroundings(error)
        if fault is None:
            complain(_internal(error))
            return OUR_FAULT
        for sentence in fault.sentences if isinstance(fault, FaultyFileError) else [str(fault)]:
            complain(sentence)
        return WRONG_INPUT
    return 0


def _check_given(arguments: list[str]) -> None:
    """Refuse an empty argument: as a path it would be the current folder.

    Raises:
        InputError: there is one.
    """
    for previous, text in pairwise(["", *arguments]):
        name, equals, value = text.partition("=")
        if not text or (name.startswith("--") and equals and not value):
            subject = name or (previous if previous.startswith("--") else "an argument")
            raise input_error(subject, "empty", "a name, a path or a number", "give it, or leave it out")


def _report_lost_output(output: Guarded) -> int:
    """Say that standard output was lost, and return the status; a stream that was closed on purpose is no fault."""
    reason = output.error and output.error.strerror
    if not reason:
        return 0
    complain(f"standard output cannot be written ({reason}), what was printed is lost; files that the command writes are complete.")
    return OUTPUT_LOST


def _internal(error: Exception) -> str:
    handle, path = tempfile.mkstemp(prefix="bayes-body-", suffix=".log")
    with os.fdopen(handle, "w", errors="backslashreplace") as log:
        log.write("".join(traceback.format_exception(error)))
    return f"an internal error, {type(error).__name__}: {error}; this is a bug in the program: report it with the details in {path}."


if __name__ == "__main__":
    main()
