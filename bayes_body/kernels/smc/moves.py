"""Markov moves that leave a density invariant, by Hamiltonian Monte Carlo or a random walk, and the chain of moves of one particle.

Moves use whitened coordinates, in which the target is approximately N(0, 1). Both moves evaluate the density at one place in the program, in a loop
over the points that they visit, including the first. Each occurrence of a whole body's likelihood costs seconds of compilation. A library's move
contains it twice: at its start and in its steps. A caller who needs the likelihood of the end point would add a third (docs/decisions).
"""

from collections.abc import Callable, Mapping
from typing import Literal, NamedTuple

import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float

from bayes_body.base.errors import input_error
from bayes_body.base.shapes import Index, Key, Scalar
from bayes_body.density.density import Density
from bayes_body.density.extended import Extended
from bayes_body.density.factor import State
from bayes_body.density.gaussian_view import GaussianView
from bayes_body.density.sharding import varying_like
from bayes_body.density.tempering import LogTerms
from bayes_body.kernels.weights import LogWeights

type Position = Mapping[str, Array]
type MoveName = Literal["hmc", "random_walk"]
# The log-density, and those of its terms that are tempered.
type Target = Callable[[Position], tuple[Scalar, LogTerms]]

# Limits of the step size's random factor. On a nearly Gaussian target, trajectories of constant length would return to their starts.
JITTER = (0.6, 1.4)
# The gain with which the acceptance rate of moves adapts the logarithm of the next step size.
GAIN = 1.0


def check_gradients(density: Density, user: str, alternative: str = "") -> None:
    """Raise an error unless every likelihood has a gradient.

    Args:
        density: the density of a frame.
        user: what needs the gradient, in the user's terms.
        alternative: a further remedy besides a look-up with a gradient.

    Raises:
        InputError: a likelihood has no gradient.
    """
    if density.without_gradient:
        problem, remedy = f"'{density.without_gradient[0]}' has no gradient", f'set its lookup = "bilinear"{alternative}'
        raise input_error("the likelihood", problem, f"a likelihood with a gradient, for {user}", remedy)


class Moved(NamedTuple):
    """The end of a move, the tempered terms and the slope of the log-density there, and the acceptance rate of the move.

    A random walk does not compute the slope; it is NaN.
    """

    position: Position
    terms: LogTerms
    slope: Position
    acceptance_rate: Scalar


class Move(NamedTuple):
    """A Markov kernel.

    Attributes:
        step: (key, position, target, step size) -> one move.
        acceptance_rate: the rate to which the step size is adapted.
        step_size: the first step size, as a function of the number of coordinates.
        evaluations: number of evaluations of the density per move.
    """

    step: Callable[[Key, Position, Target, Scalar], Moved]
    acceptance_rate: float
    step_size: Callable[[int], float]
    evaluations: int

    def adapt(self, log_step_size: Scalar, acceptance_rate: Scalar) -> Scalar:
        """Return the logarithm of the next step size. An acceptance rate of NaN, where nothing was moved, leaves it unchanged."""
        return log_step_size + jnp.where(jnp.isnan(acceptance_rate), 0.0, GAIN * (acceptance_rate - self.acceptance_rate))


class _Point(NamedTuple):
    """A point of a trajectory: log-density minus kinetic energy, the tempered terms, and the slope of the log-density."""

    position: Position
    log_density: Scalar
    terms: LogTerms
    slope: Position


def hmc(leapfrog_steps: int) -> Move:
    """Return a move by Hamiltonian Monte Carlo with unit mass (Neal 2011, 5.2). The step size is jittered by ±40 %."""

    def step(key: Key, position: Position, target: Target, step_size: Scalar) -> Moved:
        momentum, (jitter, accept) = _random(key, position, 2)
        size = step_size * (JITTER[0] + (JITTER[1] - JITTER[0]) * jitter)

        def visit(k: Index, walker: tuple[Position, Position, _Point, _Point]) -> tuple[Position, Position, _Point, _Point]:
            position, momentum, first, _ = walker
            (log_density, terms), slope = jax.value_and_grad(target, has_aux=True)(position)
            # Half a kick at each end, and whole kicks in between. The energy is computed after the first half of a kick.
            ends = (k == 0) | (k == leapfrog_steps)
            half = _shifted(momentum, slope, size / 2)
            point = _Point(position, log_density - _kinetic(jax.tree.map(lambda p, h: jnp.where(k == 0, p, h), momentum, half)), terms, slope)
            kicked = jax.tree.map(lambda h, g: jnp.where(ends, h, h + size / 2 * g), half, slope)
            onward = _shifted(position, kicked, jnp.where(k == leapfrog_steps, 0.0, size))
            return onward, kicked, jax.tree.map(lambda new, old: jnp.where(k == 0, new, old), point, first), point

        nan = varying_like(jnp.full_like(_kinetic(position), jnp.nan), position)
        unvisited = _Point(position, nan, LogTerms(nan, nan), dict(position))
        start = position, momentum, unvisited, unvisited
        *_, first, last = jax.lax.fori_loop(0, leapfrog_steps + 1, visit, start)
        return _accept(accept, first, last)

    return Move(step, 0.8, lambda dofs: 0.9 * dofs**-0.25, leapfrog_steps + 1)


def random_walk() -> Move:
    """Return a move by random-walk Metropolis with a Gaussian step. The first step size is 2.38 / sqrt(d) (Roberts, Gelman & Gilks 1997)."""

    def step(key: Key, position: Position, target: Target, step_size: Scalar) -> Moved:
        direction, (accept,) = _random(key, position, 1)
        proposed = _shifted(position, direction, step_size)
        candidates = jax.tree.map(lambda current, proposal: jnp.stack([current, proposal]), dict(position), proposed)
        log_densities, terms = jax.lax.map(target, candidates)
        points = _Point(candidates, log_densities, terms, jax.tree.map(lambda x: jnp.full_like(x, jnp.nan), candidates))
        first, last = (jax.tree.map(lambda leaf, k=k: leaf[k], points) for k in (0, 1))
        return _accept(accept, first, last)

    return Move(step, 0.25, lambda dofs: 2.38 * dofs**-0.5, 2)


def _accept(level: Scalar, first: _Point, last: _Point) -> Moved:
    """Accept or reject by the Metropolis rule; NaN is rejected."""
    log_ratio = last.log_density - first.log_density
    rate = jnp.exp(jnp.minimum(jnp.where(jnp.isnan(log_ratio), -jnp.inf, log_ratio), 0.0))
    # Not "<": a level may be rounded to 1.
    accepted = level <= rate
    end = jax.tree.map(lambda new, old: jnp.where(accepted, new, old), last, first)
    return Moved(end.position, end.terms, end.slope, rate)


def _random(key: Key, like: Position, levels: int) -> tuple[dict[str, Array], Float[Array, " {levels}"]]:
    """Return standard normal numbers with the form of a position, and some uniform numbers, all from one draw.

    Each occurrence of a random generator adds to a program's compile time.
    """
    joined, form = ravel_pytree(dict(like))
    # Without the barrier, XLA repeats the draw wherever a part of it is read.
    normals = jax.lax.optimization_barrier(jax.random.normal(key, (joined.size + levels,), joined.dtype))
    return form(normals[: joined.size]), jax.scipy.special.ndtr(normals[joined.size :])


def _shifted(position: Position, direction: Position, size: Scalar | float) -> dict[str, Array]:
    return {name: value + size * direction[name] for name, value in position.items()}


def _kinetic(momentum: Position) -> Scalar:
    return sum((0.5 * jnp.sum(p * p) for p in momentum.values()), jnp.zeros(()))


# -- particles of the extended view -----------------------------------------------------------------------------------------------------------


class ExtendedParticle(NamedTuple):
    """A point of the extended view: its ancestor, its unconstrained coordinates, and the tempered terms there.

    The slope is the gradient of the log-density that was the target of the last move.
    """

    ancestor: Index
    position: dict[str, Array]
    terms: LogTerms
    slope: dict[str, Array]


class MoveSettings(NamedTuple):
    """The settings of one stage's moves: the powers, step size, and for each variable a root of the covariance, for whitening."""

    powers: LogTerms
    step_size: Scalar
    whitening: dict[str, Float[Array, "dof dof"]]


def walk(
    key: Key, particle: ExtendedParticle, view: Extended | GaussianView, settings: MoveSettings, move: Move, moves: int, candidates: int
) -> tuple[ExtendedParticle, Scalar, Scalar]:
    """Return the chain of a particle's states (a leading axis of `moves`), the mean acceptance rate, and the share of impossible proposals.

    Args:
        key: random key.
        particle: the start.
        view: the target.
        settings: the settings of the stage.
        move: a Markov kernel.
        moves: the chain's length.
        candidates: number of candidates among which the ancestor is redrawn before the first move.
    """
    ancestor_key, *move_keys = jax.random.split(key, 1 + moves)
    likelihood, potential = settings.powers
    ancestor = view.choose_ancestor(ancestor_key, particle.ancestor, particle.position, likelihood, candidates, potential)

    def coordinates(whitened: State) -> dict[str, Array]:
        return {name: jnp.sum(settings.whitening[name] * value, axis=-1) for name, value in whitened.items()}

    def target(whitened: State) -> tuple[Scalar, LogTerms]:
        log_density, terms = view.log_density(ancestor, coordinates(whitened), likelihood, potential)
        # Without potentials their sum is a constant, but in a loop over devices it must have the type of the likelihood.
        return log_density, varying_like(terms, log_density)

    def solved(values: State, transposed: int) -> dict[str, Array]:
        roots = settings.whitening
        return {name: jax.scipy.linalg.solve_triangular(roots[name], x, lower=True, trans=transposed) for name, x in sorted(values.items())}

    def advance(whitened: State, move_key: Key) -> tuple[State, tuple[dict[str, Array], LogTerms, dict[str, Array], Scalar]]:
        moved = move.step(move_key, whitened, target, settings.step_size)
        return moved.position, (coordinates(moved.position), moved.terms, solved(moved.slope, 1), moved.acceptance_rate)

    _, (chain, terms, slopes, rates) = jax.lax.scan(advance, solved(particle.position, 0), jnp.stack(move_keys))
    return ExtendedParticle(jnp.broadcast_to(ancestor, (moves,)), chain, terms, slopes), jnp.mean(rates), jnp.mean(rates == 0)


def whitening(position: Float[Array, "particle dof"], log_weights: LogWeights) -> Float[Array, "dof dof"]:
    """Return a root L of the weighted covariance. If z is standard normal, L z spreads like the particles."""
    return jnp.linalg.cholesky(shrunk_covariance(position, log_weights))


def shrunk_covariance(values: Float[Array, "particle dof"], log_weights: LogWeights) -> Float[Array, "dof dof"]:
    """Return the weighted covariance, shrunk by a tenth towards its diagonal."""
    weights = jax.nn.softmax(log_weights)[:, None]
    # A particle with weight zero may be NaN.
    clean = jnp.where(weights > 0, values, 0.0)
    centred = jnp.where(weights > 0, clean - jnp.sum(weights * clean, axis=0), 0.0)
    return shrunk((weights * centred).T @ centred, 0.1)


def shrunk(covariance: Float[Array, "dof dof"], share: float | Scalar) -> Float[Array, "dof dof"]:
    """Return a covariance with its correlations reduced by a share, and with variances above zero."""
    variances = jnp.diagonal(covariance)
    floor = jnp.maximum(1e-6 * jnp.max(variances), 1e-10)
    return (1 - share) * covariance + jnp.diag(share * variances + floor)
