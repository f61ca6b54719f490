"""The settings of a run: the user's, those of a run that is continued, and the defaults."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

from bayes_body.base.errors import input_error
from bayes_body.results.storage import FrameFiles
from bayes_body.results.storage.names import FRAMES_FOLDER, RESULTS, RUN_FILE
from bayes_body.results.storage.run_file import read_record, read_run_file, refuse_links

# Where the first pose comes from: from the session, or from the pictures where the session gives none; or from the pictures in any case.
GIVEN, AUTO = "given", "auto"
DEFAULTS = {"runs": 1, "seed": 0, "init": GIVEN}

type Record = dict[str, dict[str, Any]]


@dataclass(frozen=True)
class Settings:
    """The settings that the user gives. A value of None is replaced by that of the continued run, or else of the model, the session or DEFAULTS.

    Attributes:
        session: folder of the session.
        out: folder of the run.
        model: a definition's name or path; None chooses one by the session's data (`choose_model`).
        kernel: a kernel's name; None means the model's own.
        overrides: options of the kernel that differ from the definition's.
        runs: number of independent filters.
        first_frame: number of the first frame that is tracked, as in the file names; None for the session's first.
        frames: number of frames; None for all.
        seed: seed of everything random.
        init: where the first pose comes from, GIVEN or AUTO.
        recover: whether a run that lost the person starts anew where detectors find it; None means: for the kernel `particle_bp`.
        resume: whether to continue the run in the folder.
        keep: number of draws of a frame and run that are stored; None for all particles.
    """

    session: Path
    out: Path
    model: str | None = None
    kernel: str | None = None
    overrides: Mapping[str, Any] = field(default_factory=dict)
    runs: int | None = None
    first_frame: int | None = None
    frames: int | None = None
    seed: int | None = None
    init: str | None = None
    recover: bool | None = None
    resume: bool = False
    keep: int | None = None


class Chosen(NamedTuple):
    """Settings with their defaults.

    None means: for `model`, chosen by the session's data; for `kernel`, the model's own; for `first_frame`, the session's; for `frames`, all; for
    `recover`, by the kernel; for `keep`, all particles.
    """

    model: str | None
    kernel: str | None
    runs: int
    first_frame: int | None
    frames: int | None
    seed: int
    init: str
    recover: bool | None
    keep: int | None


def choose(settings: Settings, stored: Mapping[str, Mapping[str, Any]] | None) -> Chosen:
    """Return each setting: the user's value, or else the value of the run that is continued, or else the default."""
    defaults = DEFAULTS if stored is None else {**stored["run"], "kernel": stored["kernel"]["kind"]}
    values: dict[str, Any] = {name: getattr(settings, name) for name in Chosen._fields}
    chosen: dict[str, Any] = {name: defaults.get(name) if value is None else value for name, value in values.items()}
    return Chosen(**chosen)


def stored_record(settings: Settings) -> Record | None:
    """Return the tables of the run that is to be continued; None if a new run is started. The folder must be locked.

    Raises:
        InputError: a new run is to be started in a folder that has a run, or files that a run would replace; or the run's file cannot be read.
    """
    out = settings.out
    refuse_links(out)
    if settings.resume and (out / RUN_FILE).exists():
        record = read_run_file(out)
        if record.get("smoothing"):
            raise input_error(out, "a smoothed run", "the run of a filter", "continue it with `bayes-body smooth`")
        return record
    refuse_occupied(out)
    return None


def refuse_occupied(out: Path) -> None:
    """Check that a new run can be made in a folder.

    Raises:
        InputError: it has a run, or files that a run would replace.
    """
    refuse_links(out)
    frames = len(FrameFiles(out / FRAMES_FOLDER))
    if frames and (out / RUN_FILE).exists():
        problem = f"holds a run that has {frames} frames"
        remedy = "continue it with --resume, or name another folder with --out"
        raise input_error(out, problem, "a folder without a run", remedy)
    # A run that stopped before its first frame may be started anew. Everything else may be somebody's work.
    taken = [name for name in RESULTS if (out / name).exists()]
    if taken:
        remedy = "name another with --out, continue it with --resume, or remove it" if (out / RUN_FILE).exists() else "name another with --out"
        raise input_error(out, f"holds {taken[0]}, which a run would replace", "a folder without a run", remedy)
    if (out / RUN_FILE).exists():
        # A file of that name that is not a run's is not replaced either.
        read_record(out)
