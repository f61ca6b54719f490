"""The settings of a run: those that the user gives, those of the run that is continued, and the defaults."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

from bayes_body.errors import input_error
from bayes_body.storage import FrameFiles
from bayes_body.storage.names import FRAMES_FOLDER, POSTERIOR_FILE, RUN_FILE, SUMMARY_FILE
from bayes_body.storage.run_file import read_run_file

DEFAULTS = {"runs": 1, "seed": 0}

type Record = dict[str, dict[str, Any]]


@dataclass(frozen=True)
class Settings:
    """What the user asks for. A value of None comes from the run that is continued, or else from the model, the session or DEFAULTS.

    Attributes:
        session: folder of the session.
        out: folder of the run.
        model: a definition's name or path; None lets the session decide (`choose_model`).
        kernel: a kernel's name; None takes the model's own.
        overrides: options of the kernel that differ from the definition's.
        runs: number of independent filters.
        frames: number of frames; None for all.
        seed: of everything random.
        resume: whether to continue the run in the folder.
    """

    session: Path
    out: Path
    model: str | None = None
    kernel: str | None = None
    overrides: Mapping[str, Any] = field(default_factory=dict)
    runs: int | None = None
    frames: int | None = None
    seed: int | None = None
    resume: bool = False


class Chosen(NamedTuple):
    """Settings with their defaults. `model` None: the session decides; `kernel` None: the model's own; `frames` None: all."""

    model: str | None
    kernel: str | None
    runs: int
    frames: int | None
    seed: int


def choose(settings: Settings, stored: Mapping[str, Mapping[str, Any]] | None) -> Chosen:
    """Each value as the user gives it, or else as the run that is continued has it, or else the default."""
    defaults = DEFAULTS if stored is None else {**DEFAULTS, **stored["run"], "kernel": stored["kernel"].get("kind")}
    values: dict[str, Any] = {name: getattr(settings, name) for name in Chosen._fields}
    chosen: dict[str, Any] = {name: defaults.get(name) if value is None else value for name, value in values.items()}
    return Chosen(**chosen)


def stored_record(settings: Settings) -> Record | None:
    """The tables of the run that is to be continued; None if a new run begins.

    Raises:
        InputError: a new run is asked for in a folder that holds one, or the run's file cannot be read.
    """
    out, frames = settings.out, len(FrameFiles(settings.out / FRAMES_FOLDER))
    if settings.resume:
        # A folder without frames holds a run that stopped before its first frame, or none: the same command begins it.
        return read_run_file(out) if frames or (out / RUN_FILE).exists() else None
    for name in (POSTERIOR_FILE, SUMMARY_FILE):
        if (out / name).exists():
            remedy = "name another with --out, continue it with --resume, or remove it"
            raise input_error(out, f"holds another run ({name})", "a folder without one", remedy)
    if frames:
        found, remedy = f"holds a run that stopped at frame {frames}", "continue it with --resume, or name another folder with --out"
        raise input_error(out, found, "a folder without one", remedy)
    return None
