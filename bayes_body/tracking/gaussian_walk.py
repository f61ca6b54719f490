"""The walk of Gaussian paths without moves (kernels/paths/rts.py): all runs and several frames in one program.

A step takes milliseconds, and so does a call of a program, or the wait for a file to be on the disk. So they come once for a piece of frames. The
devices share the runs. While they compute a piece, the host stores the piece before it and reads the next one.
"""

import time
from collections.abc import Callable, Iterator, Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.stages import Compiled
from jaxtyping import Array, Bool

from bayes_body.base.shapes import Index, Key, Keys
from bayes_body.density.factor import Particles, State, Transition
from bayes_body.kernels.paths import rts
from bayes_body.tracking.draws import FrameResult
from bayes_body.tracking.program import side_by_side

# Number of frames in a program. More would hardly save time, and a walk of few frames computes so many.
PIECE = 16


class Piece(NamedTuple):
    """Frames of the paths of all runs.

    Attributes:
        filtered: the filters' frames, the last one first.
        states: whole states (run, frame, path, ...).
        seconds: wall-clock seconds.
        seconds_ready: seconds before until the program was compiled.
    """

    filtered: list[FrameResult]
    states: dict[str, np.ndarray]
    seconds: float
    seconds_ready: float


class _OfRuns(NamedTuple):
    """What the runs have of their own, with a leading axis (run,).

    Attributes:
        begins: whether paths begin at a frame (run, frame), without a next frame.
        particles: the particles of the filter (run, frame, particle, ...).
        nexts: states of the paths in the frame after the piece (run, path, ...).
    """

    begins: Bool[Array, "run frame"]
    particles: Particles
    nexts: State


def gaussian_pieces(
    keys: list[Key], transition: Transition, paths: int, filtered: Callable[[int], FrameResult], count: int, nexts: Mapping[str, Any] | None = None
) -> Iterator[Piece]:
    """Yield the frames of Gaussian paths in pieces, the last frame first.

    Args:
        keys: random key of each run; the frame's number is folded into it.
        transition: a motion prior with quantiles, whose memory is one frame.
        paths: number of paths of a run.
        filtered: frame number -> the filters' frame. The number may be `count` if `nexts` are given.
        count: number of frames, from the first one of the filters.
        nexts: the states of the paths in frame `count` (run, path, ...), if there are any.
    """
    layout, last = side_by_side(len(keys)), time.perf_counter()
    run_keys, prior = layout.scatter(jnp.stack(keys)), layout.place(transition)
    next_states: Any = layout.scatter(_no_states(keys, transition, paths, filtered(count - 1)) if nexts is None else dict(nexts))
    program, waiting, ready = None, list[tuple[list[FrameResult], Any]](), 0.0
    for high in range(count - 1, -1, -PIECE):
        frames = range(high, max(high - PIECE, -1), -1)
        next_restarted = None if nexts is None and high == count - 1 else filtered(high + 1).restarted
        results = [filtered(frame) for frame in frames]
        numbers, begins, particles = _stacked(frames, results, next_restarted)
        arguments = (run_keys, layout.place(numbers), _OfRuns(layout.scatter(begins), layout.scatter(particles), next_states), prior)
        if program is None:
            began = time.perf_counter()
            program = _compiled(layout.spread(lambda *inputs: _of_runs(paths, *inputs)), arguments)
            ready = time.perf_counter() - began
        next_states, states = program(*arguments)
        for piece in waiting:
            yield _fetched(*piece, last, ready)
            last, ready = time.perf_counter(), 0.0
        waiting = [(results, states)]
    for piece in waiting:
        yield _fetched(*piece, last, ready)


def _of_runs(paths: int, keys: Keys, numbers: Array, of_runs: _OfRuns, transition: Transition) -> tuple[State, State]:
    """Return the states of the last frame of a piece, and of all of its frames, for the runs of a device."""

    def of_run(run: tuple[Key, _OfRuns]) -> tuple[State, State]:
        key, (begins, particles, nexts) = run

        def step(nexts: State, frame: tuple[Index, Array, Particles]) -> tuple[State, State]:
            number, begins_here, particles = frame
            begin_key, step_key = jax.random.split(jax.random.fold_in(key, number))
            states = jax.lax.cond(
                begins_here,
                lambda: rts.last_states(begin_key, particles, paths, transition),
                lambda: rts.states_before(step_key, particles, nexts, transition),
            )
            return states, states

        return jax.lax.scan(step, nexts, (numbers, begins, particles))

    return jax.lax.map(of_run, (keys, of_runs))


def _compiled(function: Callable[..., Any], arguments: tuple[Any, ...]) -> Compiled:
    return jax.jit(function).lower(*arguments).compile()


def _no_states(keys: list[Key], transition: Transition, paths: int, frame: FrameResult) -> dict[str, np.ndarray]:
    """Return states of the right form, in place of those after the last frame."""
    particles = Particles({name: values[0] for name, values in frame.states.items()}, frame.log_weights[0])
    form = jax.eval_shape(lambda key, particles: rts.last_states(key, particles, paths, transition), keys[0], particles)
    return {name: np.zeros((len(keys), *leaf.shape), leaf.dtype) for name, leaf in form.items()}


def _stacked(frames: range, results: list[FrameResult], next_restarted: np.ndarray | None) -> tuple[np.ndarray, Any, Particles]:
    """Return the numbers, the places where paths begin, and the particles of a piece. A shorter piece is filled up with its last frame.

    Args:
        frames: the numbers of the frames.
        results: the filters' frames.
        next_restarted: which runs start anew in the next frame; None if there is none.
    """
    runs, missing = results[0].log_weights.shape[0], PIECE - len(frames)
    begins = [
        np.ones(runs, bool) if next_restarted is None else _flags(next_restarted, runs),
        *(_flags(result.restarted, runs) for result in results[:-1]),
    ]
    filled = [*results, *results[-1:] * missing]
    states: dict[str, Any] = {name: np.stack([result.states[name] for result in filled], axis=1) for name in results[0].states}
    log_weights: Any = np.stack([result.log_weights for result in filled], axis=1)
    numbers = np.array([*frames, *[frames[-1]] * missing], np.int32)
    return numbers, np.stack([*begins, *begins[-1:] * missing], axis=1), Particles(states, log_weights)


def _flags(restarted: Bool[np.ndarray, " stored"], runs: int) -> Bool[np.ndarray, " run"]:
    return np.asarray(restarted, bool) if restarted.size else np.zeros(runs, bool)


def _fetched(filtered: list[FrameResult], states: Any, began: float, ready: float) -> Piece:
    fetched = {name: values[:, : len(filtered)] for name, values in jax.device_get(dict(states)).items()}
    return Piece(filtered, fetched, time.perf_counter() - began - ready, ready)
