"""What the host does for a frame, and how fast a recording is followed the first time and again. `python tests/bench/host_pipeline.py [--json F]`.

Without --session, a walk is filmed by four cameras of 640 x 480 pixels, whose silhouettes come from a film of the empty room. In a first pass, every
silhouette is computed; a second one finds them in memory. The silhouettes are forgotten between passes by calling the recording by another name.

Seconds are processor time of the whole process, so that other work on the machine matters less; frames a second are by the clock.
"""

import argparse
import json
import statistics
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import bayes_body

# Before the other imports, which may touch JAX.
bayes_body.configure()

import cv2  # noqa: E402
import jax  # noqa: E402
import numpy as np  # noqa: E402

from bayes_body.base.files.shipped import definitions_folder  # noqa: E402
from bayes_body.kernels.batching import everywhere  # noqa: E402
from bayes_body.model.build import Model  # noqa: E402
from bayes_body.recording.observation.frames import read_frame  # noqa: E402
from bayes_body.recording.observation.silhouettes import background_of  # noqa: E402
from bayes_body.recording.readers.rig import read_rig  # noqa: E402
from bayes_body.recording.session.session import Session  # noqa: E402
from bayes_body.tracking.observations import Observed  # noqa: E402
from bayes_body.tracking.track import track  # noqa: E402

sys.path.append(str(Path(__file__).parents[2] / "inference" / "papers" / "darby_2008"))
sys.path.append(str(Path(__file__).parents[2] / "inference" / "papers"))
from few_cameras import with_cameras  # noqa: E402
from filmed_walk import film  # noqa: E402

# Frames whose stages are timed one by one.
STAGE_FRAMES = 20


def stages(session: Session, model: Model) -> Iterator[tuple[str, list[float]]]:
    """Milliseconds of each stage in each of the first frames, one after the other in one thread; nothing of them was computed before."""
    milliseconds: dict[str, list[float]] = {name: [] for name in ("decoding", "silhouettes", "maps", "to the devices")}
    for index in range(min(STAGE_FRAMES, session.frames)):
        frame = _timed(milliseconds["decoding"], lambda index=index: _decoded(session, index, model))
        _timed(milliseconds["silhouettes"], lambda frame=frame: None if frame.masks is None else list(frame.masks))
        data = _timed(milliseconds["maps"], lambda frame=frame: jax.block_until_ready(model.observe(frame)))
        _timed(milliseconds["to the devices"], lambda data=data: jax.block_until_ready(everywhere(data)))
    yield from milliseconds.items()


def _decoded(session: Session, index: int, model: Model) -> Any:
    frame = read_frame(session, index, model.reads_before)
    _ = list(frame.images)
    return frame


def _timed(milliseconds: list[float], work: Callable[[], Any]) -> Any:
    start = time.process_time()
    result = work()
    milliseconds.append(1e3 * (time.process_time() - start))
    return result


def step(session: Session, model: Model, seed: int) -> list[float]:
    """Milliseconds of each frame whose data are on the devices before. The program is compiled here."""
    frames = [read_frame(session, index, model.reads_before) for index in range(min(STAGE_FRAMES, session.frames))]
    ready = [Observed(np.array(frame.seen), everywhere(model.observe(frame)), None) for frame in frames]
    seconds: list[float] = []
    for _ in range(2):
        seconds = [time.process_time()]
        track(
            jax.random.key(seed),
            session,
            model,
            frames=len(ready),
            arriving=(data for data in ready),
            on_frame=lambda _, clock=seconds: clock.append(time.process_time()),
        )
    return [1e3 * (after - before) for before, after in pairwise(seconds[1:])]


def follow(session: Session, model: Model, seed: int) -> tuple[float, float]:
    """Track the session once. Return frames a second by the clock, and milliseconds of processor time a frame."""
    clock, processor = time.perf_counter(), time.process_time()
    track(jax.random.key(seed), session, model)
    return session.frames / (time.perf_counter() - clock), 1e3 * (time.process_time() - processor) / session.frames


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--session", type=Path, help="folder with a session.toml; by default a walk is filmed")
    parser.add_argument("--model", default="darby_2008", help="a model (%(default)s: the guided filter of few_cameras.py)")
    parser.add_argument("--cameras", type=int, default=2, help="use the first so many (%(default)s)")
    parser.add_argument("--frames", type=int, default=100, help="(%(default)s)")
    parser.add_argument("--passes", type=int, default=3, help="first passes, and second ones (%(default)s)")
    parser.add_argument("--json", type=Path, help="write the figures there, too")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        if options.session is None:
            rig = read_rig(definitions_folder() / "rigs" / "room_4.toml")
            film(folder / "walk", rig, options.frames, 0, None, "a walk in a room", bayes_body.watched("filming"))
        figures = measured((options.session or folder / "walk").resolve(), folder, options)
    if options.json:
        options.json.write_text(json.dumps(figures, indent=2))


def measured(source: Path, folder: Path, options: argparse.Namespace) -> dict[str, Any]:
    """Print the figures, and return them by name."""
    whole = bayes_body.load_session(source)
    whole = replace(whole, frames=min(whole.frames, options.frames))
    session = with_cameras(whole, options.cameras) if whole.truth else replace(whole, views=whole.views[: options.cameras])
    names = [folder / f"name_{number}" for number in range(2)]
    for link in names:
        link.symlink_to(source)
    figures: dict[str, Any] = {}
    sizes = ", ".join(f"{width} x {height}" for width, height in dict.fromkeys(view.camera.size_px for view in session.views))
    print(f"{len(session.views)} cameras of {sizes}, {session.frames} frames, {options.model}, {len(jax.devices())} devices")
    threads = cv2.getNumThreads()
    cv2.setNumThreads(1)
    start = time.process_time()
    for view in session.views:
        if view.masks is None:
            background_of(session, view)
    figures["backgrounds, s"] = time.process_time() - start
    print(f"{'backgrounds of all cameras, once':34} {figures['backgrounds, s']:8.2f} s of processor time")
    model = bayes_body.load_model(options.model, session, lambda line: None)
    print(f"{'ms of processor time a frame':34} {'median':>8} {'least':>8} {'most':>8}")
    for name, milliseconds in [*stages(replace(session, folder=names[0]), model), ("the step", step(session, model, 0))]:
        figures[name] = statistics.median(milliseconds)
        print(f"{name:34} {figures[name]:8.1f} {min(milliseconds):8.1f} {max(milliseconds):8.1f}", flush=True)
    cv2.setNumThreads(threads)
    for link in names:
        for view in session.views:
            if view.masks is None:
                background_of(replace(session, folder=link), view)
    print(f"{'passes':34} {'frames/s':>8} {'ms':>8}")
    for number in range(options.passes):
        for name in ("first pass", "second pass"):
            rate, milliseconds = follow(replace(session, folder=names[number % 2]), model, number)
            figures.setdefault(name, []).append((rate, milliseconds))
            print(f"{name:34} {rate:8.1f} {milliseconds:8.1f}", flush=True)
    return figures


if __name__ == "__main__":
    main()
