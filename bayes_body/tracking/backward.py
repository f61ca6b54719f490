r"""Walk back through the frames of one filter run, and yield all paths frame by frame (kernels/paths/smoother.py).

The last frame comes first. A first walk, which reads no images, lays the paths. A second walk follows some frames behind and moves each state given
the frames before and after it. Memory holds a few frames, however many there are in all. A run that continues repeats the first walk, which is fast;
its second walk goes on from the stored frames.

If the transition's memory has no bound, as with a filter of activities that each particle carries along, paths follow the filter's ancestors and are
not moved. That is exact too, but few paths are distinct.
"""

from collections.abc import Callable, Iterator
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Int

from bayes_body.base.errors import input_error
from bayes_body.base.shapes import Key, Scalar
from bayes_body.density.ahead import Ahead
from bayes_body.density.density import Density
from bayes_body.density.factor import Particles, State, Transition
from bayes_body.density.gaussian_view import has_quantiles
from bayes_body.kernels.paths.ensemble import LinearPrediction
from bayes_body.kernels.paths.smoother import OnParticles, Smoother
from bayes_body.tracking.backward_steps import BackwardSteps

# Folded into the key of the second walk, so that its random numbers differ from those of the first.
MOVES = 1


class Filtered(NamedTuple):
    """One frame of a filter.

    Attributes:
        particles: its particles.
        ancestors: the index of each particle's ancestor among the particles of the frame before.
        begins: whether no transition leads here from a stored frame: the first frame, or the first after a loss.
        fixed: whether the states stay as they are, as in a frame that no particle explained.
    """

    particles: Particles
    ancestors: Int[Array, " particle"]
    begins: bool
    fixed: bool = False


class PathFrame(NamedTuple):
    """One frame of all paths.

    Attributes:
        frame: its number.
        states: whole states (path, ...).
        begins: whether the paths begin here, so that the frame before belongs to other paths.
        acceptance_rate: of the moves; NaN without moves.
        log_step_size: logarithm of the step size for the frame before.
        prediction: the linear prediction of the frames after it, if the first walk used one.
    """

    frame: int
    states: State
    begins: bool
    acceptance_rate: Scalar
    log_step_size: Scalar
    prediction: LinearPrediction | None = None


class _Laid(NamedTuple):
    """The position of the first walk: a frame, the paths' states in it, the indices of their ancestors in the frame before, and the frames ahead."""

    frame: int
    states: State
    ancestors: Int[Array, " path"]
    next_frames: Ahead
    density: Density | None
    begins: bool
    prediction: LinearPrediction | None = None


def check_gaussian(transition: Transition, particles: Particles) -> None:
    """Check that paths can go back by moments.

    Raises:
        InputError: the motion prior depends on more than one frame, or has no quantiles.
    """
    if transition.frames_read != 1 or not has_quantiles(transition, jax.tree.map(lambda leaf: leaf[0], particles.states)):
        problem = f"the dynamics '{transition.name}' depend on more than one frame, or have no quantiles"
        raise input_error("start: gaussian", problem, "dynamics of independent dofs that depend on the frame before", "give --start ensemble")


class Backward:
    """Paths through the frames of one filter run.

    Args:
        smoother: chooses and moves the states.
        transition: the motion prior.
        filtered: frame number -> that frame of the filter.
        density: (frame number, particles of the frame before) -> the density of the frame; its data matter only if states are moved or a factor reads
            the frame before.
    """

    def __init__(self, smoother: Smoother, transition: Transition, filtered: Callable[[int], Filtered], density: Callable[[int, Particles], Density]):
        self.smoother, self.filtered, self.density, self.memory = smoother, filtered, density, transition.frames_read
        self.steps = BackwardSteps(smoother, transition)
        # What a state carries is known only when this many frames before it are known.
        self.delay = 0 if self.memory is None else self.memory - 1

    def follow(self, key: Key, count: int, stored: Callable[[int], PathFrame] | None = None, first: int | None = None) -> Iterator[PathFrame]:
        """Yield the frames of the paths, the last one first.

        Args:
            key: random key; the frame's number is folded into it.
            count: number of frames of the filter.
            stored: frame number -> a frame that was yielded before.
            first: the lowest number of a stored frame, from which to continue; None to begin at the last frame.
        """
        if self.smoother.options.start == "gaussian":
            check_gaussian(self.steps.transition, self.filtered(0).particles)
        laid = self._final(self._lay(key, count))
        if not self.smoother.options.moves or self.memory is None:
            return (path_frame for path_frame in laid if first is None or path_frame.frame < first)
        return self._final(self._move(jax.random.fold_in(key, MOVES), laid, stored, count if first is None else first))

    def _final(self, frames: Iterator[PathFrame]) -> Iterator[PathFrame]:
        """Yield each frame as soon as the frames before it determine what its states carry."""
        waiting: list[PathFrame] = []
        for current in frames:
            waiting = [current, *waiting]
            completed = waiting[:1]
            for path_frame in waiting[1:]:
                completed.append(path_frame._replace(states=self.steps.carried(completed[-1].states, path_frame.states)))
            yield from reversed(completed if current.begins else completed[self.delay :])
            waiting = [] if current.begins else waiting[: self.delay]

    # -- the first walk ---------------------------------------------------------------------------------------------------------------------

    def _lay(self, key: Key, count: int) -> Iterator[PathFrame]:
        next_position, nan = None, jnp.full((), jnp.nan)
        for frame in range(count - 1, -1, -1):
            next_position = self._step_back(jax.random.fold_in(key, frame), frame, self.filtered(frame), next_position)
            yield PathFrame(frame, next_position.states, next_position.begins, nan, nan, next_position.prediction)

    def _step_back(self, key: Key, frame: int, filtered: Filtered, next_position: _Laid | None) -> _Laid:
        """Return the paths at a frame, given their later frames."""
        begin_key, step_key = jax.random.split(key)
        particles, prediction = filtered.particles, None
        if self.smoother.options.start == "gaussian":
            nexts = None if next_position is None or next_position.begins else next_position.states
            states = self.steps.last_states(begin_key, particles) if nexts is None else self.steps.states_before(step_key, particles, nexts)
            return _Laid(frame, states, self.steps.no_ancestors, self.steps.none_ahead(self.steps.sampled(states)), None, filtered.begins)
        if next_position is None or next_position.begins:
            index = self.steps.begin(begin_key, particles)
            states, next_frames = self.steps.states_at(particles, index), None
        elif self.memory is None:
            index = next_position.ancestors
            states, next_frames = self.steps.states_at(particles, index), next_position.next_frames
        else:
            next_frames = self.steps.pushed(next_position.next_frames, self.steps.sampled(next_position.states))
            if self.smoother.options.start == "particles":
                density = self.density(frame + 1, particles)
                paths = OnParticles(next_position.ancestors, self.steps.sampled(next_position.states), next_position.next_frames)
                linked = density if density.reads_previous else None
                # Without a frame ahead, this link has no effect; a density of the same form lets the same program run.
                index = self.steps.choose(step_key, paths, density, linked if next_position.density is None else next_position.density)
                states = self.steps.states_at(particles, index)
                return _Laid(frame, states, self.steps.ancestors_at(filtered.ancestors, index), next_frames, linked, filtered.begins)
            index = self.steps.begin(begin_key, particles)
            predict_key, step_key = jax.random.split(step_key)
            prediction = self.steps.predict(predict_key, particles)
            states = self.steps.regress(step_key, particles, index, next_frames, prediction)
        next_frames = self.steps.none_ahead(self.steps.sampled(states)) if next_frames is None else next_frames
        return _Laid(frame, states, self.steps.ancestors_at(filtered.ancestors, index), next_frames, None, filtered.begins, prediction)

    # -- the second walk --------------------------------------------------------------------------------------------------------------------

    def _move(self, key: Key, laid: Iterator[PathFrame], stored: Callable[[int], PathFrame] | None, first: int) -> Iterator[PathFrame]:
        """Yield the moved frames before frame `first`."""
        current, next_frames, next_density, step_size = next(laid), None, None, self.steps.first_step_size(self.filtered(0).particles)
        while current is not None:
            previous_frame = next(laid, None)
            if current.frame >= first and stored is not None:
                moved = stored(current.frame)._replace(begins=current.begins)
                next_density = self._link(current) if current.frame == first else None
            else:
                moved, next_density = self._frame(
                    jax.random.fold_in(key, current.frame), current, previous_frame, next_frames, next_density, step_size
                )
                yield moved
            step_size, sampled = moved.log_step_size, self.steps.sampled(moved.states)
            # The frame before the beginning of these paths belongs to other paths.
            next_frames = (
                None if current.begins else self.steps.pushed(self.steps.none_ahead(sampled) if next_frames is None else next_frames, sampled)
            )
            next_density = None if current.begins else next_density
            current = previous_frame

    def _link(self, path_frame: PathFrame) -> Density | None:
        """Return the density of a frame if it reads the frame before, whose states are to be moved next."""
        if path_frame.begins or self.filtered(path_frame.frame).fixed:
            return None
        density = self.density(path_frame.frame, self.filtered(path_frame.frame - 1).particles)
        return density if density.reads_previous else None

    def _frame(
        self,
        key: Key,
        path_frame: PathFrame,
        previous_frame: PathFrame | None,
        next_frames: Ahead | None,
        next_density: Density | None,
        step_size: Scalar,
    ) -> tuple[PathFrame, Density | None]:
        """Return one frame with its states moved, and its density if the frame before needs it."""
        filtered = self.filtered(path_frame.frame)
        # Near the beginning of the paths, what a state carries comes from a particle, not from the path.
        early = any(self.filtered(path_frame.frame - k).begins for k in range(1, self.delay + 1) if path_frame.frame >= k)
        if path_frame.begins or previous_frame is None or filtered.fixed or early:
            return path_frame._replace(log_step_size=step_size), None
        previous, sampled = self.filtered(path_frame.frame - 1).particles, self.steps.sampled(path_frame.states)
        density = self.density(path_frame.frame, previous)
        # Without a frame ahead, this link has no effect; a density of the same form lets the same program run.
        linked = (density if next_frames is None else next_density) if density.reads_previous else None
        neighbours = (previous_frame.states, self.steps.none_ahead(sampled) if next_frames is None else next_frames)
        predict_key, move_key = jax.random.split(key)
        prediction = self.steps.predict(predict_key, filtered.particles) if path_frame.prediction is None else path_frame.prediction
        moved = self.steps.move(move_key, sampled, *neighbours, density, prediction, step_size, linked)
        states = self.steps.completed(previous_frame.states, moved.sampled)
        step_size = self.steps.adapted(step_size, moved.acceptance_rate)
        return PathFrame(path_frame.frame, states, False, moved.acceptance_rate, step_size), density if density.reads_previous else None
