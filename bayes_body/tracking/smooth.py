"""Smooth a filtered session: draw paths through all frames, from the frames of its filters (tracking/backward.py).

The last frame is computed and stored first (`LastFirst`). Each run of the filter gives its own paths. A lost frame counts as a frame without images:
its states follow from its neighbours and are not moved. No path leads across a restart.
"""

import time
from collections import OrderedDict
from collections.abc import Callable, Iterable, Iterator
from contextlib import closing
from dataclasses import replace
from functools import lru_cache
from itertools import chain, islice
from typing import Any, NamedTuple

import jax
import numpy as np

from bayes_body.base.errors import input_error
from bayes_body.base.shapes import Key
from bayes_body.density.density import Density
from bayes_body.density.factor import Particles
from bayes_body.density.kernel import NO_ANCESTOR, FilterInfo
from bayes_body.kernels.batching import everywhere
from bayes_body.kernels.paths.smoother import Smoother
from bayes_body.model.build import Model
from bayes_body.recording.session.session import Session
from bayes_body.tracking.backward import Backward, Filtered, PathFrame, check_gaussian
from bayes_body.tracking.backward_steps import HELD, Begun, Near
from bayes_body.tracking.draws import FrameResult, Frames, FrameStore
from bayes_body.tracking.gaussian_walk import gaussian_pieces
from bayes_body.tracking.observations import Observed, observations_backwards


class SmoothProgress(NamedTuple):
    """The figures of a progress bar: frames done, frames in all, mean seconds a frame so far, and the smallest number of distinct states of a run."""

    frame: int
    frames: int
    seconds_per_frame: float
    distinct: int


class LastFirst:
    """A view, in the order of time, of frames that are stored from the last to the first."""

    def __init__(self, stored: Frames):
        self._stored = stored

    def __len__(self) -> int:
        return len(self._stored)

    def __getitem__(self, index: int, /) -> FrameResult:
        if not -len(self) <= index < len(self):
            raise IndexError(index)
        return self._stored[len(self) - 1 - index % len(self)]

    def __iter__(self) -> Iterator[FrameResult]:
        return (self[index] for index in range(len(self)))


def smooth(
    session: Session,
    model: Model,
    smoother: Smoother,
    filtered: Frames,
    key: Key,
    into: FrameStore,
    on_frame: Callable[[SmoothProgress], None] | None = None,
) -> LastFirst:
    """Draw paths, and return their frames in the order of time.

    Args:
        session: the recording.
        model: the model with which the session was filtered.
        smoother: from `kernels.smoother.build_smoother`.
        filtered: the frames of the filters.
        key: random key of all paths.
        into: the store of the frames, the last frame first; those that it holds already are not computed again.
        on_frame: called after each frame is stored.

    Raises:
        InputError: a frame cannot be read or stored, or `into` holds more frames than the filters have.
    """
    count, done, seconds = len(filtered), len(into), 0.0
    number = done
    if done > count:
        raise input_error("the frames of the smoother", str(done), f"at most the {count} of the filter", "start again in another folder")
    if done < count:
        # If a factor reads the frame before, the first walk needs all images again.
        last = count - 1 if model.reads_before or not done else count - 1 - done
        near = Near(filtered)
        with closing(_Recording(session, model, smoother, near, last)) as recording:
            walk = _Walk(model, smoother, near, into, recording)
            for results in walk.pieces(key):
                into.extend(results)
                for result in results:
                    number, seconds = number + 1, seconds + result.seconds
                    if on_frame is not None:
                        on_frame(SmoothProgress(number, count, seconds / (number - done), int(result.info.ess.min())))
    return LastFirst(into)


def smooth_window(session: Session, model: Model, smoother: Smoother, filtered: Frames, key: Key, frames: range) -> list[FrameResult]:
    """Draw paths through a window, given the images up to its end. Return its frames in the order of time.

    Args:
        session: the recording.
        model: the model with which the session was filtered.
        smoother: from `kernels.smoother.build_smoother`.
        filtered: the frames of the filters.
        key: random key of all paths.
        frames: consecutive numbers of frames.

    Raises:
        InputError: a frame cannot be read.
    """
    near = Near(Begun(filtered, frames.stop))
    with closing(_Recording(session, model, smoother, near, frames[-1])) as recording:
        walk = _Walk(model, smoother, near, [], recording)
        return list(islice(chain.from_iterable(walk.pieces(key)), len(frames)))[::-1]


class _Recording:
    """The data of frames, asked for in descending order; each is read once, and only if it is needed."""

    def __init__(self, session: Session, model: Model, smoother: Smoother, filtered: Frames, last: int):
        moves = smoother.options.moves > 0 and model.transition.frames_read is not None
        self.needed = moves or model.reads_before
        self._data, self._next = observations_backwards(session, model, last, lambda frame: filtered[frame].seen.tolist()), last
        # Runs that restarted are some frames ahead of the others.
        self._held: OrderedDict[int, Observed] = OrderedDict()

    def read(self, frame: int) -> Observed | None:
        """Return the data of a frame; None if they do not matter."""
        while self.needed and self._next >= frame:
            self._held[self._next] = next(self._data)
            self._next -= 1
            if len(self._held) > HELD:
                self._held.popitem(last=False)
        return self._held.get(frame)

    def close(self) -> None:
        """Stop reading."""
        self._data.close()


class _Walk:
    """The walk of all runs side by side."""

    def __init__(self, model: Model, smoother: Smoother, filtered: Frames, stored: Frames, recording: _Recording):
        placed = {name: everywhere(getattr(model, name)) for name in ("transition", "factors")}
        self.model, self.smoother, self.filtered, self.stored, self.recording = replace(model, **placed), smoother, filtered, stored, recording
        self.runs = filtered[0].log_weights.shape[0]
        self._placed = lru_cache(HELD * self.runs)(self._filtered)

    def pieces(self, key: Key) -> Iterator[list[FrameResult]]:
        """Yield the frames of all runs in pieces of one or more, the last frame first."""
        options, keys = self.smoother.options, [jax.random.fold_in(key, run) for run in range(self.runs)]
        return self._gaussian(keys) if options.start == "gaussian" and not options.moves else self._single(keys)

    def _gaussian(self, keys: list[Key]) -> Iterator[list[FrameResult]]:
        check_gaussian(self.model.transition, self._filtered(0, 0).particles)
        count, draws = len(self.filtered) - len(self.stored), self.smoother.options.draws
        nexts = self.stored[-1].states if self.stored else None
        for piece in gaussian_pieces(keys, self.model.transition, draws, self.filtered.__getitem__, count, nexts):
            seconds = piece.seconds / len(piece.filtered)
            # Noise has made all paths different.
            nan = np.full(self.runs, np.nan, np.float32)
            unmoved = _Moves(np.full(self.runs, draws), nan, nan)
            yield [
                self._result(
                    frame, {name: values[:, place] for name, values in piece.states.items()}, unmoved, seconds, 0.0 if place else piece.seconds_ready
                )
                for place, frame in enumerate(piece.filtered)
            ]

    def _single(self, keys: list[Key]) -> Iterator[list[FrameResult]]:
        count, done = len(self.filtered), len(self.stored)
        follow = [self._run(run).follow(keys[run], count, self._stored(run), count - done if done else None) for run in range(self.runs)]
        last = time.perf_counter()
        for number, path_frames in enumerate(_one_ahead(zip(*follow, strict=True))):
            paths = jax.device_get(path_frames)
            last, seconds = time.perf_counter(), time.perf_counter() - last
            states = {name: np.stack([np.asarray(path.states[name]) for path in paths]) for name in self.filtered[paths[0].frame].states}
            rates, steps = (np.array([getattr(path, name) for path in paths]) for name in ("acceptance_rate", "log_step_size"))
            moves = _Moves(np.array([_distinct(path.states) for path in paths]), rates, steps)
            # The first frame of a process waits for the compiler.
            yield [self._result(self.filtered[paths[0].frame], states, moves, seconds if number else 0.0, 0.0 if number else seconds)]

    def _run(self, run: int) -> Backward:
        return Backward(self.smoother, self.model.transition, lambda frame: self._placed(run, frame), self._density)

    def _filtered(self, run: int, frame: int) -> Filtered:
        filtered = self.filtered[frame]
        particles = Particles({name: values[run] for name, values in filtered.states.items()}, filtered.log_weights[run])
        restarted = bool(filtered.restarted.size and filtered.restarted[run])
        fixed = bool(np.asarray(filtered.info.lost)[run])
        return Filtered(*everywhere((particles, filtered.info.ancestors[run].astype(np.int32))), frame == 0 or restarted, fixed)

    def _density(self, frame: int, previous: Particles) -> Density:
        observed = self.recording.read(frame)
        if observed is None:
            return Density(self.model.transition, self.model.factors, {}, previous)
        return Density(self.model.transition, self.model.factors if observed.factors is None else observed.factors, observed.data, previous)

    def _stored(self, run: int) -> Callable[[int], PathFrame]:
        def path_frame(frame: int) -> PathFrame:
            smoothed = self.stored[len(self.filtered) - 1 - frame]
            states = {name: values[run] for name, values in smoothed.states.items()}
            info = smoothed.info
            states, rate, step = everywhere((states, info.acceptance_rate[run, 0], info.markov["log_step"][run, 0]))
            return PathFrame(frame, states, False, rate, step)

        return path_frame

    def _result(self, filtered: FrameResult, states: dict[str, np.ndarray], moves: "_Moves", seconds: float, ready: float) -> FrameResult:
        draws = self.smoother.options.draws
        evaluations = self.smoother.options.moves * self.smoother.move.evaluations
        dtype = filtered.log_weights.dtype
        ones = np.ones((self.runs, 1), dtype)
        info: dict[str, Any] = {
            "ancestors": np.full((self.runs, draws), NO_ANCESTOR, np.int32),
            "ess": moves.distinct.astype(dtype),
            "survival_rate": ones,
            "inverse_temperatures": ones,
            "log_evidence": np.asarray(filtered.info.log_evidence),
            "lost": np.asarray(filtered.info.lost),
            "acceptance_rate": moves.acceptance_rate.astype(dtype)[:, None],
            "evaluations": (draws * evaluations * np.isfinite(moves.acceptance_rate)).astype(np.int32),
            "markov": {"log_step": moves.log_step[:, None]},
        }
        log_weights = np.full((self.runs, draws), -np.log(draws), dtype)
        return FrameResult(states, log_weights, FilterInfo(**info), filtered.seen, seconds, ready, filtered.restarted)


class _Moves(NamedTuple):
    """For each run, the number of different states, the acceptance rate of the moves and the logarithm of their step size; NaN without moves."""

    distinct: np.ndarray
    acceptance_rate: np.ndarray
    log_step: np.ndarray


def _one_ahead[Item](items: Iterable[Item]) -> Iterator[Item]:
    """Yield each item after asking for the next one, so that the devices compute a frame while the frame before it is stored."""
    buffer = list[Item]()
    for item in items:
        yield from buffer
        buffer = [item]
    yield from buffer


def _distinct(states: Any) -> int:
    """Return the number of different states among the paths."""
    rows = np.concatenate([np.asarray(leaf).reshape(len(leaf), -1) for leaf in jax.tree.leaves(dict(states))], axis=1)
    return len(np.unique(rows, axis=0))
