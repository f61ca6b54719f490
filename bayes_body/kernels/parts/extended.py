r"""Particles of the extended space: an ancestor $i$ among the particles of the frame before, and a state in coordinates without limits.

$$\log \pi_\beta(i, x) = \log w_i + \log p(s(x) \mid s^i_{t-1}) + \log C + \beta \log L + \log |\det \partial s / \partial x|.$$

Functions here are of one particle; a `Frame` is what all particles of a frame share.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float
from numpyro.distributions import biject_to
from numpyro.distributions.transforms import Transform

from bayes_body.density.factor import FrameDensity, Particles, State
from bayes_body.kernels.parts.feynman_kac import LOG_ZERO
from bayes_body.kernels.parts.moves import Move
from bayes_body.kernels.parts.weights import LogWeights
from bayes_body.shapes import Index, Key, Scalar


class Extended(NamedTuple):
    """A particle: its ancestor, its coordinates without limits, and the log-likelihood there."""

    ancestor: Index
    position: dict[str, Array]
    log_likelihood: Scalar


class Frame(NamedTuple):
    """The density of a frame, the particles of the frame before, and these particles' cumulated weights."""

    density: Any
    previous: Particles
    cumulated: Float[Array, " particle"]


class Moving(NamedTuple):
    """How the particles of one stage move: the temperature, the size of a step, and by variable the root of the covariance that whitens it."""

    beta: Scalar
    scale: Scalar
    roots: dict[str, Float[Array, "dof dof"]]


def make_frame(density: FrameDensity, previous: Particles) -> Frame:
    """What all particles share."""
    return Frame(density, previous, jnp.cumsum(jnp.exp(previous.log_weights - jnp.max(previous.log_weights))))


def parent(frame: Frame, ancestor: Index) -> State:
    """One particle of the frame before."""
    return jax.tree.map(lambda leaf: leaf[ancestor], frame.previous.states)


def bijections(frame: Frame) -> dict[str, Transform]:
    """From coordinates without limits to each variable's support, which is the same after every ancestor."""
    supports = frame.density.transition.conditional(parent(frame, jnp.asarray(0)))
    return {name: biject_to(distribution.support) for name, distribution in supports.items()}


def state_of(frame: Frame, ancestor: Index, position: State) -> State:
    """The whole state, with what it carries along from its ancestor."""
    sampled = {name: jnp.asarray(bijection(position[name])) for name, bijection in bijections(frame).items()}
    return frame.density.transition.carry(parent(frame, ancestor), sampled)


def predict(key: Key, ancestor: Index, frame: Frame) -> tuple[Extended, State, Scalar]:
    """A draw from the motion prior after an ancestor, as a particle and as a state, and its log-constraint."""
    previous = parent(frame, ancestor)
    # Without the barrier XLA draws the noise anew wherever the state is read.
    state = jax.lax.optimization_barrier(frame.density.transition.sample(key, previous))
    position = {name: jnp.asarray(bijection.inv(state[name])) for name, bijection in bijections(frame).items()}
    particle = Extended(ancestor, position, frame.density.log_likelihood(state, previous))
    return particle, state, frame.density.log_constraint(state, previous)


def log_likelihood(frame: Frame, ancestor: Index, position: State) -> Scalar:
    """The likelihood side of a particle."""
    return frame.density.log_likelihood(state_of(frame, ancestor, position), parent(frame, ancestor))


def log_density(frame: Frame, ancestor: Index, position: State, beta: Scalar) -> tuple[Scalar, Scalar]:
    """log π_β(x | i), up to a constant of the ancestor's, and the log-likelihood."""
    previous, state = parent(frame, ancestor), state_of(frame, ancestor, position)
    density = frame.density
    likelihood = density.log_likelihood(state, previous)
    # 0 * -inf is NaN.
    powered = beta * jnp.maximum(likelihood, LOG_ZERO)
    terms = [density.transition.log_density(state, previous), density.log_constraint(state, previous), powered]
    for name, bijection in bijections(frame).items():
        # Without it the density would be over the state, not over its coordinates.
        terms.append(jnp.sum(bijection.log_abs_det_jacobian(position[name], state[name])))
    return sum(terms, jnp.zeros(())), likelihood


def choose_ancestor(key: Key, frame: Frame, particle: Extended, beta: Scalar, candidates: int) -> Index:
    """An ancestor from p(i | x), exactly, by iterated sampling importance resampling (Andrieu, Lee & Vihola 2018).

    The present one competes with `candidates` - 1 drawn by their weights, each by how well the state follows from it.
    """
    if candidates == 1 or frame.cumulated.shape[0] == 1:
        return particle.ancestor
    draw_key, choose_key = jax.random.split(key)
    levels = frame.cumulated[-1] * jax.random.uniform(draw_key, (candidates - 1,), frame.cumulated.dtype)
    others = jnp.minimum(jnp.searchsorted(frame.cumulated, levels, side="right"), frame.cumulated.shape[0] - 1)
    rivals = jnp.concatenate([particle.ancestor[None], others.astype(particle.ancestor.dtype)])
    links = jax.vmap(lambda ancestor: _link(frame, ancestor, particle.position, beta))(rivals)
    # NaN: an ancestor from which the state cannot come.
    return rivals[jax.random.categorical(choose_key, jnp.where(jnp.isnan(links), -jnp.inf, links))]


def _link(frame: Frame, ancestor: Index, position: State, beta: Scalar) -> Scalar:
    """Of log π_β(i, x) / w_i what depends on the ancestor: the whole of it only where a factor reads the frame before."""
    if frame.density.reads_previous:
        return log_density(frame, ancestor, position, beta)[0]
    return frame.density.transition.log_density(state_of(frame, ancestor, position), parent(frame, ancestor))


def walk(key: Key, particle: Extended, frame: Frame, moving: Moving, move: Move, moves: int, candidates: int) -> tuple[Extended, Scalar]:
    """The chain of states that a particle goes through (a leading axis of `moves`), and the mean acceptance rate."""
    ancestor_key, chain_key = jax.random.split(key)
    ancestor = choose_ancestor(ancestor_key, frame, particle, moving.beta, candidates)

    def coordinates(whitened: State) -> dict[str, Array]:
        return {name: jnp.sum(moving.roots[name] * value, axis=-1) for name, value in whitened.items()}

    def target(whitened: State) -> tuple[Scalar, Scalar]:
        return log_density(frame, ancestor, coordinates(whitened), moving.beta)

    def one(whitened: State, move_key: Key) -> tuple[State, tuple[dict[str, Array], Scalar, Scalar]]:
        after = move.step(move_key, whitened, target, moving.scale)
        return after.position, (coordinates(after.position), after.log_likelihood, after.acceptance_rate)

    whitened = {name: jax.scipy.linalg.solve_triangular(moving.roots[name], value, lower=True) for name, value in sorted(particle.position.items())}
    _, (chain, likelihoods, rates) = jax.lax.scan(one, whitened, jax.random.split(chain_key, moves))
    return Extended(jnp.broadcast_to(ancestor, (moves,)), chain, likelihoods), jnp.mean(rates)


def whitening(position: Float[Array, "particle dof"], log_weights: LogWeights) -> Float[Array, "dof dof"]:
    """A root L of the weighted covariance, shrunk a tenth towards its diagonal: L z of a standard normal z spreads as the particles do."""
    weights = jax.nn.softmax(log_weights)[:, None]
    # A particle of weight zero may be NaN.
    clean = jnp.where(weights > 0, position, 0.0)
    centred = jnp.where(weights > 0, clean - jnp.sum(weights * clean, axis=0), 0.0)
    covariance = (weights * centred).T @ centred
    variances = jnp.diagonal(covariance)
    floor = jnp.maximum(1e-6 * jnp.max(variances), 1e-10)
    return jnp.linalg.cholesky(0.9 * covariance + jnp.diag(0.1 * variances + floor))
