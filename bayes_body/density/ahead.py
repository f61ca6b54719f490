r"""The frames that follow a frame on one path, as far as their transitions read that frame.

Given the rest of a path, the density of a state $s_t$ has the factor

$$\prod_{k=1}^{m} p(x_{t+k} \mid s_{t+k-1}) \; \psi_{t+1}(s_{t+1}, s_t),$$

with the sampled variables $x$, the transition's memory $m$ and the factors $\psi$ that read the previous frame. The states in between are rebuilt
from $s_t$, because what they carry depends on $s_t$, such as the previous pose of a second-order prior. With carried values that belong to another
$s_t$, the product would be a different density.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool

from bayes_body.base.shapes import Scalar
from bayes_body.density.density import Density
from bayes_body.density.factor import State, Transition


class Ahead(NamedTuple):
    """The next frames of a path, the nearest first.

    Attributes:
        sampled: their sampled variables, (frame, ...); where there is no such frame, any value inside the support.
        exists: whether there is such a frame.
    """

    sampled: State
    exists: Bool[Array, " frame"]

    def pushed(self, sampled: State, exists: bool = True) -> "Ahead":
        """Return the frames ahead of the previous frame: this frame's variables come first, and the last frame is dropped."""
        frames = {name: jnp.concatenate([sampled[name][None], values[:-1]]) for name, values in self.sampled.items()}
        return Ahead(frames, jnp.concatenate([jnp.full((1,), exists), self.exists[:-1]]))


def nothing_ahead(sampled: State, memory: int) -> Ahead:
    """Return no frames ahead, for the last frame of a path. `sampled` gives the shapes, and values inside the support."""
    filled = jax.tree.map(lambda value: jnp.broadcast_to(value, (memory, *value.shape)), dict(sampled))
    return Ahead(filled, jnp.zeros((memory,), bool))


def log_ahead(transition: Transition, state: State, next_frames: Ahead, next_density: Density | None = None) -> Scalar:
    """Return the log-density of the frames ahead given a whole state.

    Args:
        transition: the motion prior.
        state: the whole state of the frame, including what it carries.
        next_frames: the frames that follow, at least as many as the transition's memory.
        next_density: the density of the next frame, if a factor reads the previous frame.
    """
    return _log_path(transition, [dict(state)], next_frames, next_frames.exists, next_density)


def log_between(transition: Transition, previous_state: State, state: State, next_frames: Ahead, next_density: Density | None = None) -> Scalar:
    """Return the log-density of a whole state and of the frames ahead, given the state of the previous frame. Arguments are those of `log_ahead`."""
    return _log_path(
        transition, [dict(previous_state), dict(state)], next_frames, jnp.concatenate([jnp.ones((1,), bool), next_frames.exists]), next_density
    )


def _log_path(transition: Transition, path: list[State], next_frames: Ahead, exists: Bool[Array, " frame"], next_density: Density | None) -> Scalar:
    """Return the log-density of states and of the frames ahead, given the first state."""
    first = len(path) - 1
    for k in range(next_frames.exists.shape[0]):
        path.append(transition.state(path[-1], {name: values[k] for name, values in next_frames.sampled.items()}))
    if len(path) == 1:
        return jnp.zeros(())
    befores, states = (jax.tree.map(lambda *leaves: jnp.stack(leaves), *map(dict, part)) for part in (path[:-1], path[1:]))
    # All frames at once, so that the program holds the motion prior once.
    terms = jax.vmap(transition.log_density)(states, befores)
    if next_density is not None:
        terms = terms.at[first].add(next_density.links(path[first + 1], path[first]))
    return jnp.sum(jnp.where(exists, terms, 0.0))


def sampled_of(transition: Transition, state: State) -> dict[str, Array]:
    """Return the sampled variables of a whole state."""
    names = jax.eval_shape(transition.conditional, state)
    return {name: state[name] for name in names}
