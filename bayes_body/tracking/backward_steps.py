"""The compiled steps of a walk back through the frames of a filter, and the filter's frames as the walk reads them.

Each step is compiled once for all frames. The frames are read backwards, each several times while the walks are near it.
"""

from collections.abc import Callable, Iterator
from functools import cached_property, lru_cache
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Int

from bayes_body.base.shapes import Key, Scalar
from bayes_body.density.ahead import Ahead, nothing_ahead, sampled_of
from bayes_body.density.chart import Chart
from bayes_body.density.density import Density
from bayes_body.density.factor import Particles, State, Transition
from bayes_body.density.kernel import NO_ANCESTOR
from bayes_body.kernels.batching import everywhere, replicated
from bayes_body.kernels.paths import rts
from bayes_body.kernels.paths.ensemble import LinearPrediction, linear_prediction, regressed, replaced
from bayes_body.kernels.paths.smoother import Moved, Moves, Smoother, adapted, whitening_of
from bayes_body.tracking.draws import FrameResult, Frames
from bayes_body.tracking.observations import PIECE


class BackwardSteps:
    """The steps for one smoother and one motion prior."""

    def __init__(self, smoother: Smoother, transition: Transition):
        self.smoother, self.transition, self.memory = smoother, transition, transition.frames_read

    def first_step_size(self, particles: Particles) -> Scalar:
        """Return the logarithm of the step size of the first moves, for states like these."""
        first = jax.tree.map(lambda leaf: leaf[0], dict(particles.states))
        size = sum(leaf.size for leaf in jax.tree.leaves(sampled_of(self.transition, first)))
        return everywhere(jnp.log(jnp.asarray(self.smoother.move.step_size(size), particles.log_weights.dtype)))

    @cached_property
    def begin(self) -> Callable[[Key, Particles], Int[Array, " path"]]:
        """Return the particle with which each path begins."""
        return _compiled(self.smoother.begin)

    @cached_property
    def choose(self) -> Callable[..., Int[Array, " path"]]:
        """Redraw the particles of the paths (`Smoother.choose`)."""
        return _compiled(self.smoother.choose)

    @cached_property
    def states_at(self) -> Callable[[Particles, Int[Array, " path"]], State]:
        """Return the states of the particles with these indices."""
        return _compiled(lambda particles, index: jax.tree.map(lambda leaf: leaf[index], dict(particles.states)))

    @cached_property
    def ancestors_at(self) -> Callable[[Int[Array, " particle"], Int[Array, " path"]], Int[Array, " path"]]:
        """Return the ancestors of the particles with these indices."""
        return _compiled(lambda ancestors, index: ancestors[index])

    @cached_property
    def adapted(self) -> Callable[[Scalar, Scalar], Scalar]:
        """Return the logarithm of the step size for the frame before, given that of a frame and its acceptance rate."""
        return _compiled(lambda log_step_size, acceptance_rate: adapted(log_step_size, acceptance_rate, self.smoother.move))

    @cached_property
    def sampled(self) -> Callable[[State], dict[str, Array]]:
        """Return the sampled variables of whole states."""
        return _compiled(jax.vmap(lambda state: sampled_of(self.transition, state)))

    @cached_property
    def none_ahead(self) -> Callable[[State], Ahead]:
        """Return the frames ahead for the last frame of paths: none."""
        memory = self.memory or 0
        return _compiled(jax.vmap(lambda sampled: nothing_ahead(sampled, memory)))

    @cached_property
    def pushed(self) -> Callable[[Ahead, State], Ahead]:
        """Put the sampled variables of a frame in front of the frames ahead."""
        return _compiled(jax.vmap(lambda next_frames, sampled: next_frames.pushed(sampled)))

    @cached_property
    def completed(self) -> Callable[[State, State], State]:
        """Return whole states, given those of the frame before and the sampled variables."""
        return _compiled(jax.vmap(self.transition.state))

    @cached_property
    def carried(self) -> Callable[[State, State], State]:
        """Return whole states in which the parts that are carried along follow from the given states of the frame before."""
        return _compiled(jax.vmap(lambda previous_state, state: self.transition.state(previous_state, sampled_of(self.transition, state))))

    @cached_property
    def predict(self) -> Callable[[Key, Particles], LinearPrediction]:
        """Return the regression of the next frames on the particles of a frame (`kernels/paths/ensemble.py`)."""

        def linear(key: Key, particles: Particles) -> LinearPrediction:
            return linear_prediction(key, particles, self.transition, _coordinates(self.transition, particles), self.memory or 0)

        return _compiled(linear)

    @cached_property
    def regress(self) -> Callable[..., State]:
        """Return states of the frame before by regression."""

        def back(key: Key, particles: Particles, index: Int[Array, " path"], nexts: Ahead, prediction: LinearPrediction) -> State:
            chart = _coordinates(self.transition, particles)
            return replaced(particles, index, regressed(key, particles, index, nexts, self.transition, chart, prediction), self.transition)

        return _compiled(back)

    @cached_property
    def no_ancestors(self) -> Int[Array, " path"]:
        """Return the ancestors of states that are no particles."""
        return everywhere(jnp.full((self.smoother.options.draws,), NO_ANCESTOR, jnp.int32))

    @cached_property
    def last_states(self) -> Callable[[Key, Particles], State]:
        """Return states with the moments of the particles of a frame, with which Gaussian paths begin."""
        return _compiled(lambda key, particles: rts.last_states(key, particles, self.smoother.options.draws, self.transition))

    @cached_property
    def states_before(self) -> Callable[[Key, Particles, State], State]:
        """Return states of the frame before by the moments of its particles."""
        return _compiled(lambda key, particles, nexts: rts.states_before(key, particles, nexts, self.transition))

    @cached_property
    def move(self) -> Callable[..., Moved]:
        """Move the states of a frame (`Smoother.moved`), in coordinates that are whitened by a linear prediction from it."""

        def moved(
            key: Key,
            sampled: State,
            previous_states: State,
            next_frames: Ahead,
            density: Density,
            prediction: LinearPrediction,
            log_step_size: Scalar,
            next_density: Density | None,
        ) -> Moved:
            root = whitening_of(prediction.nearest().precision_between())
            return self.smoother.moved(
                key, sampled, previous_states, next_frames, Moves(density, density.coordinates(), next_density, root, jnp.exp(log_step_size))
            )

        return _compiled(moved)


def _compiled(function: Callable[..., Any]) -> Callable[..., Any]:
    """Return the compiled function. Its results are placed like its arguments, so that a result can be an argument later without another program."""
    return jax.jit(function, out_shardings=replicated())


def _coordinates(transition: Transition, particles: Particles) -> Chart:
    """Return the coordinates of the states after these particles."""
    return Density(transition, (), {}, particles).coordinates()


# Number of frames whose data are held for the runs that are behind.
HELD = 8
# Number of frames of the filter that are held: those near the walks, and those whose images are read ahead.
NEAR = HELD + 2 * PIECE


class Begun:
    """The first frames of a filter, up to a number of them."""

    def __init__(self, frames: Frames, count: int):
        self._frames, self._count = frames, count

    def __len__(self) -> int:
        return self._count

    def __getitem__(self, index: int, /) -> FrameResult:
        if not 0 <= index < self._count:
            raise IndexError(index)
        return self._frames[index]

    def __iter__(self) -> Iterator[FrameResult]:
        return (self[index] for index in range(self._count))


class Near:
    """The frames of a filter. The frames that were read last stay in memory."""

    def __init__(self, frames: Frames):
        self._frames, self._held = frames, lru_cache(NEAR)(frames.__getitem__)

    def __len__(self) -> int:
        return len(self._frames)

    def __getitem__(self, index: int, /) -> FrameResult:
        return self._held(index)

    def __iter__(self) -> Iterator[FrameResult]:
        return iter(self._frames)
