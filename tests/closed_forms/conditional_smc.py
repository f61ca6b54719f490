r"""Particle Gibbs: conditional sequential Monte Carlo with ancestor sampling (Lindsten, Jordan & Schön 2014), an exact reference for smoothers.

One sweep maps a path to another, and leaves the joint posterior of all frames invariant, whatever the number of particles. It runs a particle filter
in which one particle is the given path $x'_{1:T}$. In each frame this path gets another past: it joins particle $i$ of the frame before with
probability

$$p(i) \propto w^i_{t-1} \prod_{k=0}^{m-1} p(x'_{t+k} \mid s^{(i)}_{t+k-1})\, \psi_t(x'_t, s^i_{t-1}),$$

with the memory $m$ of the transition and with states rebuilt from particle $i$ (density/ahead.py). Without this step, the early frames of a path
would seldom change. A memory without a bound is taken as all frames, so that the work grows with the square of their number.

The filter proposes from the transition. It suits models with few dofs: with 31 dofs and a sharp likelihood the path would seldom change.
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Int

from bayes_body.base.errors import input_error
from bayes_body.base.shapes import Index, Key
from bayes_body.density.ahead import Ahead, log_ahead
from bayes_body.density.density import Density
from bayes_body.density.factor import Particles, State, Transition
from bayes_body.density.frames import Frames, Inputs
from bayes_body.kernels.weights import LogWeights


class Path(NamedTuple):
    """A path through a window.

    Attributes:
        states: whole states (frame, ...).
        before: the index of its state among the particles of the frame before the window.
    """

    states: State
    before: Index


class _Turn(NamedTuple):
    """One frame of the filter: its key, what the frame has for itself, the given path there and after it, and what the next frame has for itself."""

    key: Key
    own: Inputs
    given: State
    ahead: Ahead
    next_own: Inputs


@partial(jax.jit, static_argnames=("particles", "sweeps"))
def particle_gibbs(key: Key, path: State, frames: Frames, before: Particles, particles: int, sweeps: int) -> Path:
    """Return the path after each sweep, with a leading sweep axis.

    Args:
        key: random key.
        path: the sampled variables of the first path (frame, ...); its density must not be zero.
        frames: the frames of the window.
        before: the weighted particles of the frame before.
        particles: number of particles of the filter, the given path included.
        sweeps: number of sweeps.

    Raises:
        InputError: fewer than two particles.
    """

    def one(path: dict[str, Array], key: Key) -> tuple[dict[str, Array], Path]:
        after = conditional_smc(key, path, frames, before, particles)
        return {name: after.states[name] for name in path}, after

    return jax.lax.scan(one, dict(path), jax.random.split(key, sweeps))[1]


def conditional_smc(key: Key, path: State, frames: Frames, before: Particles, particles: int) -> Path:
    """Return another path: one sweep. The arguments are those of `particle_gibbs`.

    Raises:
        InputError: fewer than two particles.
    """
    if particles < 2:
        raise input_error("particles", str(particles), "a whole number from 2 up", "give another number")
    start_key, scan_key = jax.random.split(key)
    transition, aheads = frames.transition, _aheads(path, frames.transition)
    length = jax.tree.leaves(dict(path))[0].shape[0]
    # What follows the last frame is marked as unknown, so its data do not matter.
    next_own = jax.tree.map(lambda leaf: jnp.concatenate([leaf[1:], leaf[-1:]]), frames.inputs)

    def after(own: Inputs) -> Density | None:
        return frames.density(own, before) if frames.linked else None

    def step(parents: State, turn: _Turn) -> tuple[State, tuple[State, Int[Array, " particle"]]]:
        sample_key, choose_key = jax.random.split(turn.key)
        drawn = jax.vmap(transition.sample)(jax.random.split(sample_key, particles), parents)
        kept = transition.state(_at(parents, -1), turn.given)
        states = jax.tree.map(lambda every, one: every.at[-1].set(one), dict(drawn), dict(kept))
        log_weights = jax.vmap(frames.density(turn.own, before).log_weight)(states, parents)
        chosen = _ancestors(choose_key, Particles(states, log_weights), turn.ahead, after(turn.next_own), transition, particles)
        return _at(states, chosen), (states, chosen)

    first = _ancestors(start_key, before, _at(aheads, 0), after(_at(frames.inputs, 0)), transition, particles)
    turns = _Turn(jax.random.split(scan_key, length), frames.inputs, dict(path), jax.tree.map(lambda leaf: leaf[1:], aheads), next_own)
    _, (states, chosen) = jax.lax.scan(step, _at(dict(before.states), first), turns)
    return _traced(states, chosen, first)


def ancestor_log_weights(particles: Particles, ahead: Ahead, after: Density | None, transition: Transition) -> LogWeights:
    """Return the log-weight of each particle as the past of the given path, whose next frames are `ahead`; by weight alone after the last frame."""
    return particles.log_weights + jax.vmap(lambda state: log_ahead(transition, state, ahead, after))(dict(particles.states))


def _ancestors(key: Key, particles: Particles, ahead: Ahead, after: Density | None, transition: Transition, count: int) -> Int[Array, " particle"]:
    """Return the ancestors of the next frame's particles: drawn by weight, and the last one as the past of the given path."""
    others_key, last_key = jax.random.split(key)
    others = jax.random.categorical(others_key, _clean(particles.log_weights), shape=(count - 1,))
    last = jax.random.categorical(last_key, _clean(ancestor_log_weights(particles, ahead, after, transition)))
    return jnp.concatenate([others, last[None]])


def _clean(log_weights: LogWeights) -> LogWeights:
    # NaN marks a particle from which the path cannot come.
    return jnp.where(jnp.isnan(log_weights), -jnp.inf, log_weights)


def _aheads(path: State, transition: Transition) -> Ahead:
    """Return what follows the frame before the window, and what follows each frame of it, with a leading frame axis."""
    length = jax.tree.leaves(dict(path))[0].shape[0]
    memory = length if transition.frames_read is None else transition.frames_read
    numbers = jnp.arange(length + 1)[:, None] + jnp.arange(memory)
    return Ahead({name: values[jnp.minimum(numbers, length - 1)] for name, values in path.items()}, numbers < length)


def _traced(states: State, chosen: Int[Array, "frame particle"], first: Int[Array, " particle"]) -> Path:
    """Return the path that ends in the last particle chosen after the last frame, by going back along the ancestors."""

    def back(index: Index, frame: tuple[State, Int[Array, " particle"]]) -> tuple[Index, State]:
        states, earlier = frame
        return earlier[index], _at(states, index)

    # The ancestor of a particle is at its place in the frame before.
    earlier = jnp.concatenate([first[None], chosen[:-1]])
    before, path = jax.lax.scan(back, chosen[-1, -1], (dict(states), earlier), reverse=True)
    return Path(path, before)


def _at[Tree](tree: Tree, index: int | Int[Array, "*any"]) -> Tree:
    return jax.tree.map(lambda leaf: leaf[index], tree)
