"""The demonstration: somebody who never was walks through a room, is filmed, tracked exactly as a user's recording would be, and measured.

The walk is that of the cycle that ships (learned from one captured walker), the person and the room are drawn by the seed; neither the renderer nor
the walker has anything in common with the model's body.
"""

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from bayes_body.errors import input_error
from bayes_body.learning.walking_cycle import load_cycle, walk
from bayes_body.model.definition import definitions_folder
from bayes_body.recording.rig import read_rig
from bayes_body.runs.run import Settings, run
from bayes_body.session.read import FILE_NAME
from bayes_body.session.session import Session
from bayes_body.simulation.options import Options
from bayes_body.simulation.person import build_person
from bayes_body.simulation.session import simulate
from bayes_body.simulation.staging import centred
from bayes_body.storage.saved_run import load_run
from bayes_body.view.progress import watched
from bayes_body.view.report import write_report

RIG, MODEL = "room_4", "tempered_smc"
SESSION, RUN = "recording", "run"


class Size(NamedTuple):
    """How much is filmed, and how carefully it is tracked."""

    frames: int
    particles: int


WHOLE, QUICK = Size(60, 300), Size(12, 192)


class Demo(NamedTuple):
    """What a demonstration left: the run's summary and the files to look at."""

    summary: dict[str, Any]
    recording: Path
    overlay: Path
    report: Path
    posterior: Path


def demo(out: Path, seed: int, size: Size, show: Callable[[str], None], bar: bool) -> Demo:
    """Film, track, measure.

    Args:
        out: a folder for the recording and the run.
        seed: of the person, the walk, the room and the tracker.
        size: WHOLE or QUICK.
        show: takes lines for the user.
        bar: whether progress bars are drawn.

    Raises:
        InputError: the folder holds something already or cannot be written.
    """
    if (out / SESSION / FILE_NAME).exists() or (out / RUN).exists():
        raise input_error(out, "holds a demonstration already", "a folder without one", "name another with --out, or remove it")
    session = film(out / SESSION, seed, size.frames, bar)
    show(f"filmed     {session.frames} frames with {len(session.views)} cameras: {out / SESSION}")
    settings = Settings(out / SESSION, out / RUN, MODEL, overrides={"particles": size.particles}, seed=seed)
    summary = run(settings, show, bar)
    with load_run(out / RUN) as saved:
        report = write_report(saved, watch=watched("report", bar))
    return Demo(summary, out / SESSION, out / RUN / "overlay.mp4", report, out / RUN / "posterior.nc")


def film(folder: Path, seed: int, frames: int, bar: bool) -> Session:
    """The recording of somebody's walk, another for each seed."""
    random = np.random.default_rng([seed, 2])
    rig, person = read_rig(definitions_folder() / "rigs" / f"{RIG}.toml"), build_person(seed)
    height, heading, phase = person.build.height_m, random.uniform(-math.pi, math.pi), random.uniform()
    landmarks = walk(load_cycle(), frames / rig.fps, rig.fps, seed=seed, heading=heading, height_m=height, phase=phase)
    session, _ = simulate(
        centred(landmarks, rig.aim_m), rig, person, Options(seed=seed), folder, title=f"demonstration {seed}", watch=watched("filming", bar)
    )
    return session
