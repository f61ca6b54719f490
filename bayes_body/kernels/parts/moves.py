"""Markov moves that keep a density: Hamiltonian Monte Carlo and a random walk, of one particle, in coordinates in which the target is about N(0, 1).

Both evaluate the density at one place, in a loop over the points that they visit, the first among them. The likelihood of a whole body takes the
compiler seconds wherever it stands: a library's move has it once where it starts and once where it goes on, and a caller who wants to know the
likelihood of where it ended has it a third time (docs/decisions).
"""

from collections.abc import Callable, Mapping
from typing import Literal, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array

from bayes_body.density.factor import FrameDensity
from bayes_body.errors import input_error
from bayes_body.shapes import Index, Key, Scalar

type Position = Mapping[str, Array]
type MoveName = Literal["hmc", "random_walk"]
# The log-density, and the log-likelihood that is a part of it.
type Target = Callable[[Position], tuple[Scalar, Scalar]]

# A trajectory of one length all the time would return to where it came from on a near Gaussian target.
JITTER = (0.6, 1.4)


def check_gradients(density: FrameDensity, what: str, other: str = "") -> None:
    """That every likelihood tells where it grows.

    Args:
        density: of a frame.
        what: for which a gradient is needed, in a user's words.
        other: another remedy than a look-up with a gradient.

    Raises:
        InputError: one does not.
    """
    if density.without_gradient:
        found, remedy = f"'{density.without_gradient[0]}' has no gradient", f'set its lookup = "bilinear"{other}'
        raise input_error("the likelihood", found, f"one for {what}", remedy)


class Moved(NamedTuple):
    """Where a move ended, the log-likelihood there, and its acceptance rate."""

    position: Position
    log_likelihood: Scalar
    acceptance_rate: Scalar


class Move(NamedTuple):
    """A Markov kernel.

    Attributes:
        step: (key, position, target, scale) -> one move.
        acceptance_rate: what its scale is adapted to.
        scale: where the adaptation begins, by the number of coordinates.
        evaluations: of the density, a move.
    """

    step: Callable[[Key, Position, Target, Scalar], Moved]
    acceptance_rate: float
    scale: Callable[[int], float]
    evaluations: int


class _Point(NamedTuple):
    """A point of a trajectory: log-density less kinetic energy, and the log-likelihood."""

    position: Position
    log_density: Scalar
    log_likelihood: Scalar


def hmc(leapfrog_steps: int) -> Move:
    """Hamiltonian Monte Carlo with unit mass (Neal 2011, 5.2); the step size is jittered by ±40 %."""

    def step(key: Key, position: Position, target: Target, scale: Scalar) -> Moved:
        jitter_key, momentum_key, accept_key = jax.random.split(key, 3)
        size = scale * jax.random.uniform(jitter_key, (), scale.dtype, *JITTER)

        def visit(k: Index, walker: tuple[Position, Position, _Point, _Point]) -> tuple[Position, Position, _Point, _Point]:
            position, momentum, first, _ = walker
            (log_density, log_likelihood), slope = jax.value_and_grad(target, has_aux=True)(position)
            # Half a kick at both ends, two halves in one between: what is half done tells the energy.
            ends = (k == 0) | (k == leapfrog_steps)
            half = _along(momentum, slope, size / 2)
            here = _Point(position, log_density - _kinetic(jax.tree.map(lambda p, h: jnp.where(k == 0, p, h), momentum, half)), log_likelihood)
            kicked = jax.tree.map(lambda h, g: jnp.where(ends, h, h + size / 2 * g), half, slope)
            onward = _along(position, kicked, jnp.where(k == leapfrog_steps, 0.0, size))
            return onward, kicked, jax.tree.map(lambda new, old: jnp.where(k == 0, new, old), here, first), here

        # A loop hands on what differs from device to device where the particles do: so must what it starts from.
        unknown = _kinetic(position) * jnp.nan
        nowhere = _Point(position, unknown, unknown)
        start = position, _normal(momentum_key, position), nowhere, nowhere
        *_, first, last = jax.lax.fori_loop(0, leapfrog_steps + 1, visit, start)
        return _accept(accept_key, first, last)

    return Move(step, 0.8, lambda dofs: 0.9 * dofs**-0.25, leapfrog_steps + 1)


def random_walk() -> Move:
    """Random-walk Metropolis with a Gaussian step; begins at Roberts, Gelman & Gilks's (1997) 2.38 / sqrt(d)."""

    def step(key: Key, position: Position, target: Target, scale: Scalar) -> Moved:
        step_key, accept_key = jax.random.split(key)
        proposed = _along(position, _normal(step_key, position), scale)
        both = jax.tree.map(lambda here, there: jnp.stack([here, there]), dict(position), proposed)
        points = _Point(both, *jax.lax.map(target, both))
        first, last = (jax.tree.map(lambda leaf, k=k: leaf[k], points) for k in (0, 1))
        return _accept(accept_key, first, last)

    return Move(step, 0.25, lambda dofs: 2.38 * dofs**-0.5, 2)


def _accept(key: Key, first: _Point, last: _Point) -> Moved:
    """Metropolis's rule; what is not a number is refused."""
    log_ratio = last.log_density - first.log_density
    rate = jnp.exp(jnp.minimum(jnp.where(jnp.isnan(log_ratio), -jnp.inf, log_ratio), 0.0))
    accepted = jax.random.uniform(key, (), rate.dtype) < rate
    end = jax.tree.map(lambda new, old: jnp.where(accepted, new, old), last, first)
    return Moved(end.position, end.log_likelihood, rate)


def _normal(key: Key, like: Position) -> dict[str, Array]:
    keys = jax.random.split(key, len(like))
    return {name: jax.random.normal(own, like[name].shape, like[name].dtype) for own, name in zip(keys, sorted(like), strict=True)}


def _along(position: Position, direction: Position, size: Scalar | float) -> dict[str, Array]:
    return {name: value + size * direction[name] for name, value in position.items()}


def _kinetic(momentum: Position) -> Scalar:
    return sum((0.5 * jnp.sum(p * p) for p in momentum.values()), jnp.zeros(()))
