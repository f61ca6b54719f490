"""The demonstration: a simulated person walks through a room, is filmed and tracked like a real recording, and the result is compared with the truth.

The walk comes from the walking cycle that ships (learned from one captured walker). The seed determines the person and the room. Neither the renderer
nor the walker shares anything with the model's body. The first pose is found in the pictures. Two independent filters track the person, so that the
run can report whether they agree.
"""

import math
from collections.abc import Iterator, Mapping
from concurrent.futures import Future, ThreadPoolExecutor, wait
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

import numpy as np

from bayes_body.base.errors import input_error
from bayes_body.base.files.shipped import definitions_folder
from bayes_body.base.progress import watched
from bayes_body.initial import Show, unposed
from bayes_body.initial.search.person_search import PersonSearch
from bayes_body.model.build import build_model
from bayes_body.model.kernel_options import kernel_of, kernel_options
from bayes_body.recording.readers.rig import read_rig
from bayes_body.recording.session.read import FILE_NAME
from bayes_body.recording.session.session import Session
from bayes_body.results.metrics.figures import width
from bayes_body.results.storage.names import POSTERIOR_FILE
from bayes_body.results.storage.saved_run import load_run
from bayes_body.runs.run import run
from bayes_body.runs.settings import AUTO, Settings
from bayes_body.tracking.program import Ahead, compiled_ahead
from bayes_body.view.overlay import VIDEO
from bayes_body.view.report import write_report
from bayes_body.workshop.learning.walking_cycle import load_cycle, walk
from bayes_body.workshop.simulation.options import Options
from bayes_body.workshop.simulation.person import build_person
from bayes_body.workshop.simulation.session import simulate
from bayes_body.workshop.simulation.staging import centred

RIG, MODEL, RUNS = "room_4", "silhouettes", 2
SESSION, RUN = "recording", "run"


class Size(NamedTuple):
    """The number of frames to film, and of particles in each run."""

    frames: int
    particles: int


SHORT, LONG, QUICK = Size(30, 300), Size(60, 300), Size(12, 192)


class Demo(NamedTuple):
    """The run's summary, and the paths of the files to look at."""

    summary: dict[str, Any]
    recording: Path
    overlay: Path
    report: Path
    posterior: Path


def demo(out: Path, seed: int, size: Size, show: Show, show_run: Show, bar: bool) -> Demo:
    """Film a simulated person, track the recording and compare the result with the truth.

    Args:
        out: a folder for the recording and the run.
        seed: random seed of the person, the walk, the room and the tracker.
        size: SHORT, LONG or QUICK.
        show: called with each line about the progress.
        show_run: called with each line about the run: its figures and its warnings.
        bar: whether to show the progress on standard error.

    Raises:
        InputError: the folder already holds a demonstration or cannot be written.
    """
    if (out / SESSION / FILE_NAME).exists() or (out / RUN).exists():
        raise input_error(out, "already holds a demonstration", "a folder without one", "name another with --out, or remove it")
    with rehearsed(seed, size) as (ahead, rehearsal):
        session = film(out / SESSION, seed, size.frames, bar)
        show(f"filmed     {session.frames} frames with {len(session.views)} cameras: {out / SESSION}")
        settings = Settings(out / SESSION, out / RUN, MODEL, overrides={"particles": size.particles}, runs=RUNS, seed=seed, init=AUTO)
        show(f"tracking   first the person is looked for, then {RUNS} independent runs of {MODEL} follow: {out / RUN}")
        # A second compilation of the search beside the first would help nobody.
        wait([rehearsal])
        summary = run(settings, show_run, bar, ahead)
    with load_run(out / RUN) as saved:
        report = write_report(saved, watch=watched("report", bar))
    return Demo(summary, out / SESSION, out / RUN / VIDEO, report, out / RUN / POSTERIOR_FILE)


@contextmanager
def rehearsed(seed: int, size: Size) -> Iterator[tuple[Ahead, Future[Any]]]:
    """Compile the programs of search and tracking while the recording is filmed: a single frame, filmed before, has the same form.

    Yields:
        The program of tracking, and the search's end. An error in the search occurs again in the run, where it is reported.
    """
    with TemporaryDirectory(prefix="bayes-body-demo-") as folder, ThreadPoolExecutor(1, thread_name_prefix="rehearsal") as pool:
        session = unposed(film(Path(folder) / SESSION, seed, 1, bar=False))
        model = build_model(MODEL, session)
        kind, options = kernel_options(model.definition, None, {"particles": size.particles}, cameras=model.cameras)
        searching = pool.submit(lambda: PersonSearch(session).searched(0))
        with compiled_ahead(session, model, kernel_of(kind, options), size.particles, RUNS) as ahead:
            yield ahead, searching


def result_of(summary: Mapping[str, Any]) -> str:
    """The demonstration's result in one sentence: the error, the coverage of the intervals, and the distance between the runs."""
    lost = summary["frames_lost"]
    tracked = f"{summary['frames']} frames tracked, {lost or 'none'} lost"
    truth = f"the mean markers are {summary['error_mm_mean']:.0f} mm from the truth"
    coverage = f"{100 * summary['coverage_90']:.0f} % of it is inside the 90 % intervals ({width(summary['coverage_90'])})"
    return f"{tracked}; {truth}, and {coverage}; the means of the two runs are {summary['marker_disagreement_mm']:.0f} mm apart."


def film(folder: Path, seed: int, frames: int, bar: bool) -> Session:
    """Write the recording of a simulated walk and return its session; each seed gives a different one."""
    random = np.random.default_rng([seed, 2])
    rig, person = read_rig(definitions_folder() / "rigs" / f"{RIG}.toml"), build_person(seed)
    height, heading, phase = person.build.height_m, random.uniform(-math.pi, math.pi), random.uniform()
    landmarks = walk(load_cycle(), frames / rig.fps, rig.fps, seed=seed, heading=heading, height_m=height, phase=phase)
    session, _ = simulate(
        centred(landmarks, rig.aim_m), rig, person, Options(seed=seed), folder, title=f"demonstration {seed}", watch=watched("filming", bar)
    )
    return session
