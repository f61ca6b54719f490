"""A model, a kernel and a session make draws, frame by frame.

All frames and all runs go through one compiled program: images, particles and keys are its arguments. While the device works on a frame the host
prepares the next one's maps. Keys are folded by run and frame, so that no frame's randomness depends on how many came before it.
"""

import time
from collections.abc import Callable, Generator, Iterator
from contextlib import closing
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Array
from numpy.typing import NDArray

from bayes_body.density import Density
from bayes_body.errors import wrong
from bayes_body.factor import FilterInfo, Kernel, Particles
from bayes_body.kernels.batching import everywhere, whole
from bayes_body.model import Model
from bayes_body.observation.frames import prefetch, read_frame
from bayes_body.session import Session
from bayes_body.shapes import Key


class Progress(NamedTuple):
    """What a bar shows after a frame: how far, how fast, how well.

    Attributes:
        frame: frames done.
        frames: frames in all.
        seconds_per_frame: mean so far, all runs together, compilation left out.
        ess: smallest effective sample size over the runs, particles.
        survival_rate: smallest final survival rate over the runs.
        lost: whether a run lost this frame.
    """

    frame: int
    frames: int
    seconds_per_frame: float
    ess: float
    survival_rate: float
    lost: bool


@dataclass(frozen=True)
class Timing:
    """Wall-clock seconds: all of it, and therein until the program of a frame was ready (traced, and compiled or loaded from the cache)."""

    total: float
    compile: float


@dataclass(frozen=True)
class Draws:
    """What the filters leave behind, on the host.

    Attributes:
        model: what was tracked with.
        states: by variable, (run, frame, particle, ...).
        log_weights: normalised, (run, frame, particle).
        info: each field with leading (run, frame).
        timing: seconds.
    """

    model: Model
    states: dict[str, NDArray[Any]]
    log_weights: NDArray[np.floating]
    info: FilterInfo
    timing: Timing

    @property
    def frames_lost(self) -> list[int]:
        """Frames that at least one run could not explain."""
        return [int(frame) for frame in np.flatnonzero(np.asarray(self.info.lost).any(axis=0))]


def track(
    session: Session,
    model: Model,
    kernel: Kernel,
    key: Key,
    particles: int = 1000,
    runs: int = 1,
    frames: int | None = None,
    on_frame: Callable[[Progress], None] | None = None,
) -> Draws:
    """Filter a session.

    Args:
        session: the recording.
        model: from `load_model`, for this session.
        kernel: such as `kernels.annealed.build_kernel()`.
        key: of the whole; runs and frames fold theirs from it.
        particles: particles a run.
        runs: independent filters; ArviZ's chains.
        frames: how many frames from the first on; all by default.
        on_frame: called after each frame.

    Raises:
        InputError: no particles, runs or frames; or a frame's images cannot be read.
    """
    count = session.frames if frames is None else frames
    for name, value, most in (("particles", particles, None), ("runs", runs, None), ("frames", count, session.frames)):
        if value < 1 or (most is not None and value > most):
            raise wrong(name, str(value), f"a whole number from 1{f' to {most}' if most else ' up'}", "give another number")
    started = time.perf_counter()
    with closing(_observations(session, model, count)) as observations:
        results, ready = _filter(model, kernel, key, particles, runs, count, observations, on_frame)
    states, log_weights, info = _stack(results)
    return Draws(model, states, log_weights, info, Timing(time.perf_counter() - started, ready - started))


def _observations(session: Session, model: Model, count: int) -> Generator[Any]:
    return prefetch(range(count), lambda index: everywhere(model.observe(read_frame(session, index))))


def _filter(
    model: Model,
    kernel: Kernel,
    key: Key,
    particles: int,
    runs: int,
    count: int,
    observations: Iterator[Any],
    on_frame: Callable[[Progress], None] | None,
) -> tuple[list[list[tuple[Particles, FilterInfo]]], float]:
    """What each run made of each frame, and when (by `time.perf_counter`) the program was ready to work on the first."""
    run_keys = [everywhere(jax.random.fold_in(key, run)) for run in range(runs)]
    filters = [everywhere(model.start(particles))] * runs
    model = replace(model, transition=everywhere(model.transition), factors=everywhere(model.factors))
    step, ready, results = None, 0.0, []
    for frame, observation in enumerate(observations):
        density = model.density(observation, filters[0])
        if step is None:
            step = _compile(kernel, run_keys[0], filters[0], density)
            ready = time.perf_counter()
        index = everywhere(np.int32(frame))
        outcomes = [step(run_key, index, before, density) for run_key, before in zip(run_keys, filters, strict=True)]
        filters = [after for after, _ in outcomes]
        results.append(jax.device_get(outcomes))
        if on_frame:
            on_frame(_progress(results[-1], frame + 1, count, (time.perf_counter() - ready) / (frame + 1)))
    return results, ready


def _compile(kernel: Kernel, key: Key, particles: Particles, density: Density) -> Callable[..., Any]:
    """The program of one frame, compiled ahead: it cannot retrace; what would need a second compilation is an error rather than a silent cost."""

    def frame_of_run(run_key: Key, frame: Array, particles: Particles, density: Density) -> tuple[Particles, FilterInfo]:
        return kernel(jax.random.fold_in(run_key, frame), particles, density.given(particles))

    return jax.jit(frame_of_run, out_shardings=whole()).lower(key, everywhere(np.int32(0)), particles, density).compile()


def _progress(outcomes: list[tuple[Particles, FilterInfo]], frame: int, frames: int, seconds: float) -> Progress:
    infos = [info for _, info in outcomes]
    return Progress(
        frame=frame,
        frames=frames,
        seconds_per_frame=seconds,
        ess=min(float(info.ess) for info in infos),
        survival_rate=min(float(info.survival_rate[-1]) for info in infos),
        lost=any(bool(info.lost) for info in infos),
    )


def _stack(results: list[list[tuple[Particles, FilterInfo]]]) -> tuple[dict[str, NDArray[Any]], NDArray[np.floating], FilterInfo]:
    """From a list of frames of runs to arrays (run, frame, ...)."""
    by_run = jax.tree.map(lambda *frames: np.stack(frames), *[jax.tree.map(lambda *runs: np.stack(runs), *frame) for frame in results])
    particles, info = jax.tree.map(lambda leaf: np.swapaxes(leaf, 0, 1), by_run)
    return dict(particles.states), particles.log_weights, info
