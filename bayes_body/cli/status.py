"""`bayes-body status`: how far a study is."""

from pathlib import Path
from typing import TYPE_CHECKING

import typer

from bayes_body.cli.terminal import say

if TYPE_CHECKING:
    from bayes_body.runs.study.status import UnitState


def status(
    out: Path = typer.Argument(help="Folder of a study."),
) -> None:
    """Print how many units are done, running, failed and waiting, and why units failed. Exit status 1 if any failed."""
    from bayes_body.runs.study.status import WAITING, counts_of, status
    from bayes_body.view.study.rows import FAILED, RUNNING

    _, states = status(out)
    counts = counts_of(states)
    say(f"{len(states)} units: {', '.join(f'{count} {name}' for name, count in counts.items())}")
    for name in (RUNNING, FAILED, WAITING):
        for state in states:
            # Of the waiting ones, only those that wait for a reason.
            if state.state == name and (name != WAITING or state.sentence):
                say(f"{name:<8}  {state.unit.key}{_frames(state)}{f': {state.sentence}' if state.sentence else ''}")
    if counts[FAILED]:
        raise typer.Exit(1)


def _frames(state: "UnitState") -> str:
    if state.frames is None:
        return ""
    return f", {state.frames} of {state.unit.frames} frames" if state.unit.frames else f", {state.frames} frames"
