r"""The joint posterior of consecutive frames, as one log-density of their sampled variables in unconstrained coordinates.

$$\log \sum_i w_i \prod_{t=1}^{F} p(x_t \mid s^{(i)}_{t-1})\, \psi_t(x_t, s^{(i)}_{t-1}) \; + \sum_t \log \psi_t(x_t)\, L(z_t; x_t)\, C
  + \sum_t \log |\det \partial x_t / \partial y_t| + \log p(\mathrm{ahead} \mid s_F).$$

$(w_i, s^i_0)$ are the particles of the frame before the window: the marginal view of the first frame (density/density.py). With one particle, the
window is conditioned on that state. All states are rebuilt, beginning with the particle, so what they carry belongs to the same path, such as the
previous pose of a second-order prior. Only the first frames of the window, as many as the transition's memory, read the particle. So only their terms
are summed over the particles.

With a `prior`, one Gaussian over these first frames replaces the sum (density/window_prior.py).

Fixed frames after the window (density/ahead.py) add their density given the window. With them, the window is one block of a longer path.
"""

from dataclasses import dataclass
from functools import partial

import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float

from bayes_body.base.errors import input_error
from bayes_body.base.shapes import Index, Key, Scalar
from bayes_body.density.ahead import Ahead, log_ahead, sampled_of
from bayes_body.density.chart import Chart
from bayes_body.density.coordinates import coordinates_after
from bayes_body.density.density import Density, Predictions
from bayes_body.density.factor import Particles, State
from bayes_body.density.frames import Frames, Inputs
from bayes_body.density.sharding import varying_like
from bayes_body.density.window_prior import WindowPrior, window_prior


@partial(
    jax.tree_util.register_dataclass,
    meta_fields=[],
    data_fields=["frames", "previous", "predictions", "references", "next_frames", "next_density", "prior"],
)
@dataclass(frozen=True, eq=False)
class Trajectory:
    """The joint log-density of a window's frames. Create it with `trajectory`. A position has a leading frame axis.

    Attributes:
        frames: the frames of the window.
        previous: the particles of the frame before the window.
        predictions: the motion prior of the first frame, given each particle.
        references: (frame, ...), for each frame a state of the previous frame, around which its coordinates are defined.
        next_frames: the fixed frames after the window; None if there are none.
        next_density: the density of the first frame after the window, if a factor reads the previous frame.
        prior: the Gaussian prior of the first frames; None for the sum over the particles.
    """

    frames: Frames
    previous: Particles
    predictions: Predictions
    references: State
    next_frames: Ahead | None = None
    next_density: Density | None = None
    prior: WindowPrior | None = None

    def __call__(self, position: State) -> Scalar:
        """Return the log-density at a position, including the Jacobians, up to the evidence."""
        sampled, log_determinants = self._constrained(position)
        log_single_frames = jax.vmap(lambda inputs, current: self.frames.log_single_frame(inputs, self.frames.transition.with_derived(current)))(
            self.frames.inputs, sampled
        )
        return self._first(position, sampled, log_determinants) + self._shared_links(sampled) + jnp.sum(log_single_frames) + jnp.sum(log_determinants)

    def states(self, position: State, ancestor: int | Index = 0) -> State:
        """Return the whole states of the frames (frame, ...) at a position, given a particle of the frame before the window."""
        return self._states(self._particle(ancestor), self._constrained(position)[0])

    def sampled(self, position: State) -> dict[str, Array]:
        """Return the sampled variables of the frames (frame, ...) at a position."""
        return self._constrained(position)[0]

    def position(self, states: State) -> dict[str, Array]:
        """Return the position of states (frame, ...): the inverse of `states`."""
        return jax.vmap(lambda reference, state: self._chart(reference).unconstrain(state))(self.references, states)

    def ancestor_log_probs(self, position: State) -> Float[Array, " particle"]:
        """Return log p(i | x) of each particle of the frame before the window."""
        return self.ancestor_log_probs_of(self.sampled(position))

    def ancestor_log_probs_of(self, sampled: State) -> Float[Array, " particle"]:
        """Return log p(i | x) as `ancestor_log_probs` does, given the sampled variables of the frames."""
        return jax.nn.log_softmax(self._by_ancestor(sampled))

    def complete(self, key: Key, position: State) -> tuple[State, Index]:
        """Return the whole states at a position, and the particle before them, which is drawn from its distribution given the window."""
        ancestor = jax.random.categorical(key, self.ancestor_log_probs(position))
        return self.states(position, ancestor), ancestor

    # -- parts of the sum ---------------------------------------------------------------------------------------------------------------------

    def _constrained(self, position: State) -> tuple[dict[str, Array], Float[Array, " frame"]]:
        """Return the sampled variables of all frames, and their log-Jacobians."""

        def constrain_frame(reference: State, frame_position: State) -> tuple[dict[str, Array], Scalar]:
            chart = self._chart(reference)
            return chart.constrain(frame_position), chart.log_determinant(frame_position)

        return jax.vmap(constrain_frame)(self.references, dict(position))

    def _first(self, position: State, sampled: State, log_determinants: Float[Array, " frame"]) -> Scalar:
        """Return the prior of the first frames: the sum over the particles, or the Gaussian."""
        if self.prior is None:
            by_ancestor = self._by_ancestor(sampled)
            return by_ancestor[0] if by_ancestor.shape == (1,) else jax.nn.logsumexp(by_ancestor)
        count = self._reading(_length(sampled))
        first = jax.vmap(lambda frame: ravel_pytree(frame)[0])(_cut(dict(position), 0, count))
        # The Gaussian is a density over the coordinates.
        return self.prior.log_density(first) - jnp.sum(log_determinants[:count])

    def _chart(self, reference: State) -> Chart:
        return coordinates_after(self.frames.transition, reference)

    def _particle(self, index: int | Index) -> State:
        return jax.tree.map(lambda leaf: leaf[index], dict(self.previous.states))

    def _reading(self, count: int) -> int:
        """Return the number of first frames that are summed over the particles: all if there is one particle."""
        memory = self.frames.transition.frames_read
        summed = self.prior is not None or self.previous.log_weights.shape[0] > 1
        return min(memory, count) if summed and memory is not None else count

    def _by_ancestor(self, sampled: State) -> Float[Array, " particle"]:
        """Return, for each particle of the frame before the window, the terms that depend on it."""
        transition, count = self.frames.transition, _length(sampled)
        reading = self._reading(count)
        if self.previous.log_weights.shape[0] == 1:
            return self.previous.log_weights + self._links(self._particle(0), _cut(self.frames.inputs, 0, count), sampled, ends=True)
        first = jax.tree.map(lambda leaf: leaf[0], (self.frames.inputs, dict(sampled)))
        density = self.frames.density(first[0], self.previous)
        by_first = density.by_ancestor(transition.with_derived(first[1]), predictions=self.predictions)
        if reading == 1 and count > 1:
            return by_first

        def log_other_links(previous_state: State) -> Scalar:
            state = transition.state(previous_state, first[1])
            return self._links(state, _cut(self.frames.inputs, 1, reading), _cut(sampled, 1, reading), ends=reading == count)

        return by_first + jax.vmap(log_other_links)(dict(self.previous.states))

    def _shared_links(self, sampled: State) -> Scalar:
        """Return the links of the frames that do not read the particle before the window."""
        count = _length(sampled)
        reading = self._reading(count)
        if reading == count:
            return jnp.zeros(())
        last = jax.tree.map(lambda leaf: leaf[-1], self._states(self._particle(0), _cut(sampled, 0, reading)))
        return self._links(last, _cut(self.frames.inputs, reading, count), _cut(sampled, reading, count), ends=True)

    def _links(self, previous_state: State, inputs: Inputs, sampled: State, ends: bool) -> Scalar:
        """Return the sum of some frames' transitions, and of their factors that read the previous frame.

        Args:
            previous_state: the whole state of the frame before them.
            inputs: the frames' own factors and data.
            sampled: their sampled variables.
            ends: whether the window ends with them, so that the frames ahead are added.
        """
        total, last = jnp.zeros(()), previous_state
        if _length(sampled):
            states = self._states(previous_state, sampled)
            befores = jax.tree.map(lambda first, leaf: jnp.concatenate([first[None], leaf[:-1]]), dict(previous_state), dict(states))

            def link(inputs: Inputs, state: State, earlier: State) -> Scalar:
                return self.frames.transition.log_density(state, earlier) + self.frames.density(inputs, self.previous).links(state, earlier)

            total, last = jnp.sum(jax.vmap(link)(inputs, states, befores)), jax.tree.map(lambda leaf: leaf[-1], states)
        if ends and self.next_frames is not None:
            total += log_ahead(self.frames.transition, last, self.next_frames, self.next_density)
        return total

    def _states(self, previous_state: State, sampled: State) -> State:
        """Return the whole states of frames, given the whole state before them."""

        def advance(earlier: State, current: State) -> tuple[State, State]:
            state = self.frames.transition.state(earlier, current)
            return state, state

        return jax.lax.scan(advance, varying_like(dict(previous_state), sampled), dict(sampled))[1]


def trajectory(
    frames: Frames,
    previous: Particles,
    path: State,
    next_frames: Ahead | None = None,
    next_density: Density | None = None,
    gaussian: Key | None = None,
) -> Trajectory:
    """Return the joint log-density of a window.

    Args:
        frames: the frames of the window.
        previous: the weighted particles of the frame before the window; one particle for a known state.
        path: whole states of the window's frames (frame, ...), around which the coordinates are defined.
        next_frames: fixed frames after the window.
        next_density: the density of the first of these, if a factor reads the previous frame.
        gaussian: a random key, for a Gaussian prior of the first frames in place of the mixture of the particles' predictions.

    Raises:
        InputError: a Gaussian prior is wanted, but a term compares frames, or the motion prior remembers all earlier frames.
    """
    references = {name: jnp.concatenate([previous.states[name][:1], states[:-1]]) for name, states in path.items()}
    predictions = Density(frames.transition, (), {}, previous).predictions()
    prior = None if gaussian is None else _prior(gaussian, frames, previous, references)
    return Trajectory(frames, previous, predictions, references, next_frames, next_density if frames.linked else None, prior)


def _prior(key: Key, frames: Frames, previous: Particles, references: State) -> WindowPrior:
    if frames.linked:
        problem, expected = "a term compares a frame with the frame before", "terms that read one frame"
        raise input_error("a Gaussian prior of a window", problem, expected, 'take the mixture: prior = "particles", or --prior particles')
    memory = frames.transition.frames_read
    return window_prior(key, frames.transition, previous, references if memory is None else _cut(references, 0, memory))


def sampled_path(frames: Frames, path: State) -> dict[str, Array]:
    """Return the sampled variables of whole states (frame, ...)."""
    return jax.vmap(lambda state: sampled_of(frames.transition, state))(path)


def _length(sampled: State) -> int:
    return jax.tree.leaves(dict(sampled))[0].shape[0]


def _cut[Tree](tree: Tree, begin: int, end: int) -> Tree:
    return jax.tree.map(lambda leaf: leaf[begin:end], tree)
