r"""Backward simulation: paths from the joint posterior $p(x_{0:T} \mid z_{0:T})$ of all frames, from a filter's particles.

A path begins at its last frame and goes back in time. There are three ways to take a step.

`start = "particles"` (Godsill, Doucet & West 2004). The state at $t - 1$ is one of the filter's particles,

$$p(i \mid x_t, x_{t+1}, \ldots) \propto w^i_{t-1}\, p(x_t \mid s^i_{t-1}) \prod_{k=1}^{m-1} p(x_{t+k} \mid s_{t+k-1}^{(i)}),$$

with the memory $m$ of the transition: one density for a random walk, two for a second-order process, whose state at $t$ is rebuilt from particle $i$
(density/ahead.py). With $m = 1$ the index is drawn from all particles. With a longer memory, `candidates` indices are drawn by the first two factors
and compete by the product. The index from the filter's genealogy is among them (Dau & Chopin 2023), so this too leaves the distribution invariant.
The law of the paths is exact in the limit of many particles. But in 31 dimensions a few particles take all the weight, and the paths share their
past.

`start = "ensemble"` (kernels/paths/ensemble.py) moves a particle by linear regression on the next frames. Paths do not share their past. Their law is
exact only if everything is normal.

`start = "gaussian"` (kernels/paths/rts.py) takes the moments of the particles alone. It is the default for runs of the kernel `laplace`, without
moves.

`start = "joint"` is no walk back, and has options of its own: all paths come from one Gaussian of all frames (kernels/paths/joint/path.py).

Then each state *moves* given its neighbours on the path: HMC with the target

$$p(x_t \mid s_{t-1})\, L(z_t; x_t)\, C \prod_{k=1}^{m} p(x_{t+k} \mid s_{t+k-1}),$$

which leaves the posterior of the whole path invariant, wherever the path came from.
"""

from collections.abc import Mapping
from typing import Annotated, Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float, Int
from pydantic import Field

from bayes_body.base.errors import input_error
from bayes_body.base.inverse_cdf import inverse_cdf
from bayes_body.base.registry import find, names
from bayes_body.base.shapes import Index, Key, Scalar
from bayes_body.base.toml.read import validate
from bayes_body.base.toml.schema import Count, Schema
from bayes_body.density.ahead import Ahead, log_ahead, log_between
from bayes_body.density.chart import Chart
from bayes_body.density.density import Density, Predictions
from bayes_body.density.factor import Particles, State
from bayes_body.density.tempering import LogTerms
from bayes_body.kernels.batching import over_particles
from bayes_body.kernels.smc.moves import Move, hmc
from bayes_body.kernels.weights import LogWeights


class Options(Schema):
    """Options of the smoother.

    `draws` is the number of paths of a run. `start` says how a path goes back: over the filter's `particles`, over an `ensemble`, or by the moments
    of the particles, as if they were `gaussian`. A state moves `moves` times by trajectories of `leapfrog_steps`; with no moves, no images are read.
    `candidates` is the number of particles that compete if the transition's memory is longer than a frame.
    """

    draws: Count = 250
    start: Literal["ensemble", "particles", "gaussian"] = "ensemble"
    moves: Annotated[int, Field(strict=True, ge=0)] = 1
    leapfrog_steps: Count = 3
    candidates: Annotated[int, Field(strict=True, ge=2)] = 32


class JointOptions(Schema):
    """Options of paths that are drawn from one Gaussian of all frames (kernels/paths/joint/path.py): `draws` is the number of paths of a run.

    They neither go back frame by frame nor move.
    """

    draws: Count = 250
    start: Literal["joint"] = "joint"


def paths_options(kernel: str, given: Mapping[str, Any], stored: Mapping[str, Any] | None = None) -> Options | JointOptions:
    """Return the options of the paths of a kernel's run.

    Args:
        kernel: the kernel's name.
        given: options by name.
        stored: those of a run that is continued, where they are not given.

    Raises:
        InputError: an option does not exist, is outside its range, or does not go with `start = "joint"`.
    """
    stored = stored or {}
    if given.get("start", stored.get("start")) != "joint":
        return validate(Options, options_for(kernel, {**stored, **given}), "the smoother")
    moving = sorted({"moves", "leapfrog_steps", "candidates"} & {name for name, value in given.items() if value != 0})
    if moving:
        problem = f"given with the start 'joint', whose paths do not {'compete' if moving == ['candidates'] else 'move'}"
        raise input_error(f"--{moving[0]}", problem, "no such option", "leave it out, or choose another start")
    draws = {name: value for name, value in {**stored, **given}.items() if name in ("draws", "start")}
    return validate(JointOptions, draws, "the smoother")


def options_for(kernel: str, given: Mapping[str, Any]) -> dict[str, Any]:
    """Return options of the smoother for the run of a kernel: those that are given, and those of the kernel where they go together.

    The kernel's are taken only if neither `start` nor `moves` is given.
    """
    of_kernel = find("kernel", kernel).smoothed_by if kernel in names("kernel") else {}
    return {**({} if {"start", "moves"} & set(given) else of_kernel), **given}


class OnParticles(NamedTuple):
    """One frame of paths that consist of particles, with a leading path axis.

    Attributes:
        ancestor: index of the path's state among the particles of the frame before.
        sampled: the sampled variables of the frame.
        next_frames: the frames after it.
    """

    ancestor: Int[Array, "*path"]
    sampled: State
    next_frames: Ahead


class Moved(NamedTuple):
    """The sampled variables of all paths after the moves of a frame, and the mean acceptance rate."""

    sampled: State
    acceptance_rate: Scalar


class Moves(NamedTuple):
    """The settings that the moves of all paths share in one frame.

    Attributes:
        density: the density of the frame.
        coordinates: its unconstrained coordinates.
        next_density: the density of the next frame, if a factor reads the frame before.
        whitening: an upper triangular root of a covariance of the coordinates, in the order of `ravel_pytree`.
        step_size: step size of the trajectories.
    """

    density: Density
    coordinates: Chart
    next_density: Density | None
    whitening: Float[Array, "dof dof"]
    step_size: Scalar


class Smoother:
    """The steps of one frame, for one choice of options. Create it with `build_smoother`."""

    def __init__(self, options: Options):
        self.options = options
        self.move: Move = hmc(options.leapfrog_steps)

    def begin(self, key: Key, particles: Particles) -> Int[Array, " path"]:
        """Return an index among the particles for each path, drawn by weight."""
        return _drawn(key, particles.log_weights, self.options.draws)

    def choose(self, key: Key, paths: OnParticles, density: Density, next_density: Density | None = None) -> Int[Array, " path"]:
        """Redraw the index of each path among the particles of the frame before, given its states from this frame on.

        Args:
            key: random key.
            paths: one frame of the paths.
            density: the density of the frame, with the particles of the frame before.
            next_density: the density of the next frame, if a factor reads the frame before.
        """

        def redraw(item: tuple[Key, OnParticles], shared: tuple[Density, Predictions, Density | None]) -> Index:
            return self._chosen(*item, *shared)

        keys = jax.random.split(key, paths.ancestor.shape[0])
        return over_particles(redraw, (keys, paths), (density, density.predictions(), next_density))

    def _chosen(self, key: Key, path: OnParticles, density: Density, predictions: Predictions, next_density: Density | None) -> Index:
        """Return an index from its distribution given the path, or by a move that leaves this invariant."""
        log_probs = density.ancestor_log_probs(density.transition.with_derived(path.sampled), predictions)
        if density.transition.frames_read == 1:
            return _drawn(key, log_probs, 1)[0].astype(path.ancestor.dtype)
        draw_key, choose_key = jax.random.split(key)

        def log_next_frames(index: Index) -> Scalar:
            state = density.transition.state(density.ancestor(index), path.sampled)
            return log_ahead(density.transition, state, path.next_frames, next_density)

        if self.options.candidates > log_probs.shape[0]:
            every = jnp.arange(log_probs.shape[0], dtype=path.ancestor.dtype)
            return jax.random.categorical(choose_key, log_probs + jax.vmap(log_next_frames)(every)).astype(path.ancestor.dtype)
        rivals = _drawn(draw_key, log_probs, self.options.candidates - 1)
        competing = jnp.concatenate([path.ancestor[None], rivals.astype(path.ancestor.dtype)])
        return competing[jax.random.categorical(choose_key, jax.vmap(log_next_frames)(competing))]

    def moved(self, key: Key, sampled: State, previous_states: State, next_frames: Ahead, settings: Moves) -> Moved:
        """Move the state of each path given the frames before and after it.

        Args:
            key: random key.
            sampled: the sampled variables of the frame (path, ...).
            previous_states: whole states of the frame before.
            next_frames: the frames after it.
            settings: the settings that all paths share.
        """

        def move_path(item: tuple[Key, State, State, Ahead], settings: Moves) -> tuple[State, Scalar]:
            key, start, previous_state, next_frames = item

            # A loop, so that the program holds one move, however many there are.
            def move_once(current: State, number: Index) -> tuple[State, Scalar]:
                return self._moved(jax.random.fold_in(key, number), current, previous_state, next_frames, settings)

            last, rates = jax.lax.scan(move_once, start, jnp.arange(self.options.moves))
            return last, jnp.mean(rates)

        keys = jax.random.split(key, self.options.draws)
        variables, rates = over_particles(move_path, (keys, dict(sampled), dict(previous_states), next_frames), settings)
        return Moved(variables, jnp.mean(rates))

    def _moved(self, key: Key, sampled: State, previous_state: State, next_frames: Ahead, settings: Moves) -> tuple[State, Scalar]:
        """Return one path's variables after a trajectory, and the acceptance rate."""
        density, chart, root = settings.density, settings.coordinates, settings.whitening
        position = chart.unconstrain(sampled)
        vector, unravel = ravel_pytree(position)

        def target(whitened: State) -> tuple[Scalar, LogTerms]:
            position = unravel(root @ whitened["white"])
            state = density.transition.state(previous_state, chart.constrain(position))
            links = log_between(density.transition, previous_state, state, next_frames, settings.next_density)
            log_density = links + density.log_weight(state, previous_state) + chart.log_determinant(position)
            # Nothing is tempered.
            return log_density, LogTerms(log_density, log_density)

        start = {"white": jax.scipy.linalg.solve_triangular(root, vector, lower=False)}
        end = self.move.step(key, start, target, settings.step_size)
        moved = chart.constrain(unravel(root @ end.position["white"]))
        # A rejected move leaves the variables as they are: their way through the coordinates and back would round them.
        stayed = jnp.all(end.position["white"] == start["white"])
        return {name: jnp.where(stayed, value, moved[name]) for name, value in sampled.items()}, end.acceptance_rate


def _drawn(key: Key, log_probs: LogWeights, count: int) -> Int[Array, " drawn"]:
    """Return independent indices."""
    cumulative = jnp.cumsum(jnp.exp(log_probs - jnp.max(log_probs)))
    return inverse_cdf(cumulative, jax.random.uniform(key, (count,), cumulative.dtype))


def build_smoother(**options: int | str) -> Smoother:
    """Return a smoother.

    Args:
        options: those of `Options`.

    Raises:
        InputError: an argument that does not exist or is outside its range.
    """
    return Smoother(validate(Options, options, "smoother()"))


def adapted(log_step_size: Scalar, acceptance_rate: Scalar, move: Move) -> Scalar:
    """Return the logarithm of the step size for the frame before."""
    return move.adapt(log_step_size, acceptance_rate)


def whitening_of(precision: Float[Array, "dof dof"]) -> Float[Array, "dof dof"]:
    r"""Return an upper triangular root R of $P^{-1}$, for coordinates $x = R z$ in which the precision P becomes the identity."""
    scale = jax.lax.rsqrt(jnp.diagonal(precision))
    lower = jnp.linalg.cholesky(precision * scale[:, None] * scale)
    return scale[:, None] * jax.scipy.linalg.solve_triangular(lower, jnp.eye(len(scale), dtype=scale.dtype), lower=True).T
