"""Filter a session with a model and a kernel, frame by frame, and detect Markov chains that do not move.

All frames and all runs use one compiled program, whose arguments are images, particles and keys. While the device works on a frame, the host prepares
the data of the next one. Keys are folded by run and frame, so the randomness of a frame does not depend on how many frames came before it in this
process. A filter that continues from stored frames therefore gives the same results, bit for bit.

If no trajectory of a frame is accepted, tracking stops with an error, since all later frames would only repeat the chains' starts.
"""

import time
from collections.abc import Callable, Generator, Iterator
from contextlib import closing
from dataclasses import replace
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Array

from bayes_body.base.errors import input_error
from bayes_body.base.registry import find, names
from bayes_body.base.shapes import Key
from bayes_body.density.factor import Particles
from bayes_body.density.kernel import FilterInfo, Kernel
from bayes_body.model.build import Model
from bayes_body.model.plugins.load import check_own_factors
from bayes_body.model.plugins.terms import check_result
from bayes_body.recording.session.session import Session
from bayes_body.tracking.draws import Draws, FrameResult, FrameStore, ThinningStore, Timing, timing_of
from bayes_body.tracking.fallback import Fallback
from bayes_body.tracking.observations import Observed, observations
from bayes_body.tracking.program import Ahead, dispatch, layout_of, program_from
from bayes_body.tracking.proposing import proposer_for
from bayes_body.tracking.restarts import Recovery, Restarts

# Chains with a lower mean acceptance do not move; the suggested step is smaller by the factor REDUCTION.
LEAST_ACCEPTANCE, REDUCTION = 1e-3, 10.0
# A step factor at which trajectories are stable on most posteriors.
USUAL_STEP = 0.2


def raise_if_all_rejected(info: FilterInfo, frame: int) -> None:
    """Raise an error if no chain of a frame moves.

    Args:
        info: the diagnostics of one run and frame.
        frame: the frame's number.

    Raises:
        InputError: no chain moves, and the frame is not lost.
    """
    if not info.markov or bool(np.any(info.lost)):
        return
    acceptance, divergences, step = (np.asarray(info.markov[name], float) for name in ("acceptance", "divergences", "step"))
    if not acceptance.mean() < LEAST_ACCEPTANCE:
        return
    size = float(np.median(step))
    suggested = min(size / REDUCTION, USUAL_STEP)
    problem = f"at a step factor of {size:.3g} the acceptance is {acceptance.mean():.1g} ({divergences.sum():.0f} trajectories diverged)"
    raise input_error(
        f"frame {frame}: no chain moves", problem, "a smaller step", f"try step={suggested:.2g}, or target_acceptance=0.8, which tunes it"
    )


# Takes the place of the frame's number in the keys of the states before the first frame.
BEFORE = 2**32 - 1
# Number of particles by default, for a kernel that is a plain function.
PARTICLES = 1000


class Progress(NamedTuple):
    """The figures of a progress bar after a frame.

    Attributes:
        frame: frames done.
        frames: frames in all.
        seconds_per_frame: mean so far in this process, all runs together, without compilation.
        ess: smallest effective sample size over the runs, particles.
        survival_rate: smallest final survival rate over the runs.
        lost: whether a run lost this frame.
        result: the frame itself.
    """

    frame: int
    frames: int
    seconds_per_frame: float
    ess: float
    survival_rate: float
    lost: bool
    result: FrameResult | None = None


def track(
    key: Key,
    session: Session,
    model: Model,
    kernel: Kernel | None = None,
    particles: int | None = None,
    runs: int = 1,
    frames: int | None = None,
    on_frame: Callable[[Progress], None] | None = None,
    into: FrameStore | None = None,
    ahead: Ahead | None = None,
    recovery: Recovery | None = None,
    arriving: Generator[Observed] | None = None,
) -> Draws:
    """Filter a session. `bayes_body.track` does this and looks at the result.

    Args:
        key: random key of the whole run; each filter and frame folds its own key from it.
        session: the recording.
        model: from `initial.load_model`, for this session.
        kernel: by default the model's own, `model.kernel()`.
        particles: number of particles per run; by default the kernel's option `particles`, or 1000 if it has no options.
        runs: number of independent filters, which ArviZ calls chains.
        frames: number of frames to track, from the first; all by default. `recording.excerpt` makes a session that begins later. With `arriving`,
            the most that are tracked.
        on_frame: called after each frame is stored.
        into: the store of the frames, such as `storage.FrameFiles`; a list by default. Frames that it already holds are not computed again: the
            filters continue from the last of them.
        ahead: the result of `compiled_ahead` for this session and kernel, and for a model of the same form.
        recovery: finds the person again after a loss, such as `runs.recovery.PersonRecovery`; by default a lost run stays lost.
        arriving: yields the frames' data as they come, from the first one that `into` does not have. A frame is then stored before the next one is
            asked for. By default, the session's frames are read.

    Raises:
        InputError: no particles, runs or frames; `into` holds other numbers of them; a frame's images cannot be read, or a frame cannot be stored; no
            Markov chain of a frame accepts a move.
    """
    kernel = model.kernel() if kernel is None else kernel
    particles = _particles_of(kernel) if particles is None else particles
    count = session.frames if frames is None else frames
    most_frames = session.frames if arriving is None else None
    for name, value, most in (("particles", particles, None), ("runs", runs, None), ("frames", count, most_frames)):
        if value < 1 or (most is not None and value > most):
            raise input_error(name, str(value), f"a whole number from 1{f' to {most}' if most else ' up'}", "give another number")
    store: FrameStore = [] if into is None else into
    done = len(store)
    filters = _filters_after(store, particles, runs, count) if done else _first_filters(model, key, particles, runs)
    timing = timing_of(store)
    if done < count:
        proposer = proposer_for(session, model, kernel) if arriving is None else None
        with closing(observations(session, model, range(done, count), proposer) if arriving is None else arriving) as observed:
            restarts = None if recovery is None else Restarts(recovery, runs, store)
            computed: list[FrameResult] = []
            results = _filter(model, kernel, key, filters, done, observed, ahead, restarts, session.first_frame, computed, arriving is not None)
            timing = _follow(store, _to_the_last(results, computed), count, on_frame, timing)
    cameras = tuple(view.camera.name for view in session.views)
    name = getattr(kernel, "kind", "")
    declared = find("kernel", name).samples_posterior if name in names("kernel") else None
    return Draws(model, store, timing, cameras, session.first_frame, name, declared_sample=declared)


def _particles_of(kernel: Kernel) -> int:
    return int(getattr(getattr(kernel, "options", None), "particles", PARTICLES))


def _first_filters(model: Model, key: Key, particles: int, runs: int) -> list[Particles]:
    """Return each run's particles before the first frame."""
    return [model.start(particles, jax.random.fold_in(jax.random.fold_in(key, run), BEFORE)) for run in range(runs)]


def _filters_after(store: FrameStore, particles: int, runs: int, count: int) -> list[Particles]:
    """Return each run's particles at the last stored frame."""
    last = store.last if isinstance(store, ThinningStore) else store[len(store) - 1]
    for name, stored, requested in zip(("runs", "particles"), last.log_weights.shape, (runs, particles), strict=True):
        if stored != requested:
            raise input_error(name, str(requested), f"the {stored} of the frames that are kept", "give that number, or start again")
    if len(store) > count:
        raise input_error("frames", str(count), f"at least the {len(store)} that are kept", "give a larger number, or start again")
    return [Particles({name: values[run] for name, values in last.states.items()}, last.log_weights[run]) for run in range(runs)]


def _follow(store: FrameStore, results: Iterator[FrameResult], count: int, on_frame: Callable[[Progress], None] | None, timing: Timing) -> Timing:
    """Store each frame as soon as it is computed. Return the time of all frames, given that of those that were stored before."""
    first, seconds = len(store), 0.0
    for done, result in enumerate(results, first + 1):
        store.append(result)
        seconds += result.seconds
        timing = timing.plus(result)
        if on_frame:
            on_frame(_progress(result, done, count, seconds / (done - first)))
    return timing


def _filter(
    model: Model,
    kernel: Kernel,
    key: Key,
    filters: list[Particles],
    first: int,
    observed: Iterator[Observed],
    ahead: Ahead | None,
    restarts: Restarts | None,
    number: int,
    computed: list[FrameResult],
    at_once: bool,
) -> Iterator[FrameResult]:
    """Yield the results of all runs for each frame from `first` on. Only the particles of the last two frames stay in memory.

    A result waits in `computed` until the device works on the next frame, unless it is wanted at once. The last one stays there. `number` is the
    number of frame 0 in the recording.
    """
    last = time.perf_counter()
    layout = layout_of(kernel, len(filters))
    run_keys = layout.place([jax.random.fold_in(key, run) for run in range(len(filters))])
    filters = layout.place(filters)
    model = replace(model, **{name: layout.place(getattr(model, name)) for name in ("transition", "after_found", "factors")})
    step, fallback = None, Fallback(kernel)
    for frame, (visibility, data, factors, proposals) in enumerate(observed, first):
        restarted = np.zeros(0, bool) if restarts is None else restarts.restart(frame, filters, run_keys)
        placed = model if factors is None else replace(model, factors=layout.place(factors))
        density, ready = placed.density(layout.place(data), layout.place(filters[0]), layout.place(proposals)), 0.0
        if step is None:
            check_own_factors(density, model.initial)
            step = program_from(ahead, kernel, layout, run_keys[0], filters[0], density)
            last, ready = time.perf_counter(), time.perf_counter() - last
        index = layout.place(np.int32(frame))
        is_found = restarted if restarted.size else np.full(len(filters), frame == 0 and model.first.draws is not None)
        after_found = replace(density, transition=model.after_found)
        previous, densities = filters, [after_found if begins else density for begins in is_found]
        dispatched = dispatch(step, layout, run_keys, index, previous, densities)
        # The host stores a frame while the device works on the next one.
        if computed:
            yield computed.pop()
        runs, filters = dispatched.fetch()
        waited = fallback.replace_failed(runs, filters, run_keys, index, previous, densities)
        for particles, info in runs:
            raise_if_all_rejected(info, number + frame)
            check_result(kernel, particles, number + frame)
        last, seconds = time.perf_counter(), time.perf_counter() - last - waited
        result = _result(runs, visibility, seconds, ready + waited, restarted)
        if restarts is not None:
            restarts.watch(result, frame)
        computed.append(result)
        if at_once:
            yield computed.pop()


def _to_the_last(results: Iterator[FrameResult], computed: list[FrameResult]) -> Iterator[FrameResult]:
    """Yield the results, and the one that waits at the end. It is not lost if the next frame cannot be read or the run is stopped."""
    try:
        yield from results
    except GeneratorExit:
        raise
    except BaseException:
        yield from computed
        raise
    yield from computed


def _result(outcomes: list[tuple[Particles, FilterInfo]], visibility: np.ndarray, seconds: float, ready: float, restarted: np.ndarray) -> FrameResult:
    particles, info = jax.tree.map(lambda *leaves: np.stack(leaves), *outcomes)
    if not visibility.any():
        # No camera saw the frame, so the likelihood was the same for all particles. The kernel cannot distinguish that from a frame that it explains.
        info = info._replace(lost=np.ones_like(info.lost))
    return FrameResult(dict(particles.states), particles.log_weights, info, visibility, seconds, ready, restarted)


def _progress(result: FrameResult, frame: int, frames: int, seconds: float) -> Progress:
    return Progress(
        frame=frame,
        frames=frames,
        seconds_per_frame=seconds,
        ess=float(np.min(result.info.ess)),
        survival_rate=float(_final(result.info.survival_rate).min()),
        lost=result.lost,
        result=result,
    )


def _final(by_layer: Array | np.ndarray) -> np.ndarray:
    """Return the value at the last layer of each run. A kernel that chooses the number of layers leaves NaN in unused ones."""
    values = np.asarray(by_layer)
    reached = np.isfinite(values).sum(axis=-1)
    return values[np.arange(len(values)), np.maximum(reached, 1) - 1]
