"""Paths longer than a window: a Gibbs sweep over overlapping windows, which leaves the joint posterior of the whole path invariant.

Each window in turn moves by HMC given the frames before and after it on the same path (density/ahead.py), and the particle before the first frame is
redrawn. So overlapping windows need no stitching. The program of a sweep contains one window, whatever the number of windows.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from bayes_body.base.errors import input_error
from bayes_body.base.shapes import Index, Key, Scalar
from bayes_body.density.ahead import Ahead
from bayes_body.density.factor import Particles, State
from bayes_body.density.frames import Frames
from bayes_body.density.sharding import varying_like
from bayes_body.density.tempering import LogTerms
from bayes_body.density.trajectory import Trajectory, sampled_path, trajectory
from bayes_body.kernels.batching import over_particles
from bayes_body.kernels.paths.window import GaussianPath, Whitening, flat, position_at, whitened
from bayes_body.kernels.smc.moves import Move


class LongPath(NamedTuple):
    """A path through all frames.

    Attributes:
        sampled: its sampled variables (frame, ...).
        before: the index of its state among the particles of the frame before the first.
    """

    sampled: State
    before: Index


class Windows(NamedTuple):
    """The windows of a sweep, with a leading window axis.

    Attributes:
        begin: number of the first frame of each.
        whitening: coordinates of each, given the rest of the path.
        log_step_size: of each one's trajectories.
    """

    begin: Int[Array, " window"]
    whitening: Whitening
    log_step_size: Float[Array, " window"]


def windows_of(fitted: GaussianPath, length: int, move: Move) -> Windows:
    """Return windows of `length` frames that overlap by half and cover all frames.

    Args:
        fitted: the Gaussian process of smoothed paths through all frames (`fitted_path`).
        length: number of frames of a window.
        move: the move of `sweep`.

    Raises:
        InputError: a window has no frame, or more than there are.
    """
    frames, dofs = fitted.mean.shape
    if not 1 <= length <= frames:
        raise input_error("frames of a window", str(length), f"a whole number from 1 to {frames}", "give another number")
    begins = [*range(0, frames - length, max(length // 2, 1)), frames - length]
    whitening = jax.tree.map(lambda *leaves: jnp.stack(leaves), *(fitted.whitening(begin, length) for begin in begins))
    return Windows(jnp.asarray(begins), whitening, jnp.full(len(begins), np.log(move.step_size(length * dofs)), float))


def sweep(
    key: Key, paths: LongPath, frames: Frames, before: Particles, references: State, windows: Windows, move: Move
) -> tuple[LongPath, Float[Array, " window"]]:
    """Return paths after each window has moved once, and the mean acceptance rate of each window.

    Args:
        key: random key.
        paths: the paths, with a leading path axis.
        frames: all frames.
        before: the weighted particles of the frame before the first.
        references: whole states of one path through all frames, around which coordinates are laid. They must not change from sweep to sweep.
        windows: the windows.
        move: such as `kernels.parts.moves.hmc(8)`.
    """

    def one(item: tuple[Key, LongPath], shared: tuple[Frames, Particles, State, Windows]) -> tuple[LongPath, Float[Array, " window"]]:
        return _swept(*item, *shared, move)

    keys = jax.random.split(key, paths.before.shape[0])
    after, rates = over_particles(one, (keys, paths), (frames, before, dict(references), windows))
    return after, jnp.mean(rates, axis=0)


def _swept(
    key: Key, path: LongPath, frames: Frames, before: Particles, references: State, windows: Windows, move: Move
) -> tuple[LongPath, Float[Array, " window"]]:
    """Return one path after a sweep, and the acceptance rate of each window."""
    whole = trajectory(frames, before, references)
    redraw_key, move_key = jax.random.split(key)
    index = path.before
    if before.log_weights.shape[0] > 1:
        index = jax.random.categorical(redraw_key, whole.ancestor_log_probs_of(path.sampled)).astype(index.dtype)
    first = jax.tree.map(lambda leaf: leaf[index], dict(before.states))
    length = windows.whitening.centre.shape[1] // flat(whole.position(path.sampled)).shape[1]

    def one(sampled: dict[str, Array], turn: tuple[Key, Windows]) -> tuple[dict[str, Array], Scalar]:
        key, window = turn
        target = _window(frames, first, sampled, whole.references, window.begin, length)
        inside = jax.tree.map(lambda leaf: jax.lax.dynamic_slice_in_dim(leaf, window.begin, length), sampled)
        position = target.position(inside)

        def log_density(white: State) -> tuple[Scalar, LogTerms]:
            value = target(position_at(white["white"], window.whitening, position))
            # The move carries tempered terms along; nothing is tempered here.
            return value, varying_like(LogTerms(jnp.zeros(()), jnp.zeros(())), value)

        start = {"white": whitened(position, window.whitening)}
        after = move.step(key, start, log_density, jnp.exp(window.log_step_size))
        moved = target.sampled(position_at(after.position["white"], window.whitening, position))
        # A rejected move leaves the variables as they are: their way through the coordinates and back would round them.
        stayed = jnp.all(after.position["white"] == start["white"])
        kept = jax.tree.map(lambda new, old: jnp.where(stayed, old, new), moved, inside)
        put = jax.tree.map(lambda leaf, values: jax.lax.dynamic_update_slice_in_dim(leaf, values, window.begin, 0), sampled, kept)
        return put, after.acceptance_rate

    sampled, rates = jax.lax.scan(one, dict(path.sampled), (jax.random.split(move_key, windows.begin.shape[0]), windows))
    return LongPath(sampled, index), rates


def _window(frames: Frames, first: State, sampled: State, references: State, begin: Index, length: int) -> Trajectory:
    """Return the density of a window given the rest of its path; `first` is the path's state before all frames."""
    transition, count = frames.transition, jax.tree.leaves(dict(sampled))[0].shape[0]

    def step(earlier: State, here: State) -> tuple[State, State]:
        return transition.state(earlier, here), earlier

    # Whole states of the frame before each: what they carry follows from the path as it is now.
    befores = jax.lax.scan(step, varying_like(dict(first), sampled), dict(sampled))[1]
    known = Particles(jax.tree.map(lambda leaf: leaf[begin][None], befores), jnp.zeros(1))
    memory = count if transition.frames_read is None else transition.frames_read
    numbers = begin + length + jnp.arange(memory)
    ahead = Ahead({name: values[jnp.minimum(numbers, count - 1)] for name, values in sampled.items()}, numbers < count)
    own: Any = jax.tree.map(lambda leaf: leaf[jnp.minimum(begin + length, count - 1)], frames.inputs)
    after = frames.density(own, known) if frames.linked else None
    around = jax.tree.map(lambda leaf: jax.lax.dynamic_slice_in_dim(leaf, begin, length), dict(references))
    return Trajectory(frames.window(begin, length), known, {}, around, ahead, after)


def long_paths(frames: Frames, paths: State, before: Int[Array, " path"]) -> LongPath:
    """Return paths for `sweep` from whole states (path, frame, ...) and the indices of the particles that they come from."""
    return LongPath(jax.vmap(lambda path: sampled_path(frames, path))(dict(paths)), before)
