r"""Markov moves that leave the posterior of a frame exactly invariant: the moves of kernels, in a form that can be tested exactly.

A kernel with n particles approaches the posterior only as n grows. But take a truth, data simulated from it, and a move that leaves the posterior
given these data invariant. Then the joint distribution of truth and data is the same before and after the move (Geweke 2004; Gandy & Scott 2020). A
test of this needs no tolerance.

- `sir`: iterated sampling importance resampling (Andrieu, Lee & Vihola 2018). The current state is one of n particles. The others are predicted and
  weighted as in the filter, and one of all n is drawn by weight. This is exact for every n ≥ 2.
- `tempered`: the kernel's own move at temperature 1. The ancestor is redrawn, and the state moves in unconstrained coordinates. Whitening and step
  size must not depend on the state that is moved. So the whitening is computed from a new prediction, and each move draws its step size between
  `SCALES` times the kernel's first one. Some of these step sizes then suit the posterior, however narrow it is.
- `hmc`: the kernel's own transitions on the marginal view, followed by an ancestor drawn from p(i | state). The mass matrix is computed at a new
  prediction.
- `annealed` has no such move: no weight corrects its noise, which is a proposal.
"""

from typing import Any, Protocol

import jax
import jax.numpy as jnp
from jaxtyping import Array

from bayes_body.base.shapes import Index, Key
from bayes_body.density.density import Density
from bayes_body.density.extended import Extended, extended
from bayes_body.density.factor import Particles, State
from bayes_body.density.tempering import LogTerms
from bayes_body.kernels.hmc.hamiltonian import Schedule, run_chain
from bayes_body.kernels.hmc.mass import inverse_mass
from bayes_body.kernels.smc.moves import ExtendedParticle, Move, MoveSettings, hmc, random_walk, walk, whitening
from bayes_body.kernels.weights import predict

# The smallest and the largest step size, relative to the kernel's first one.
SCALES = (0.02, 1.0)
# The number of particles in an iterated resampling, including the current state, and the number of predictions from which a whitening is computed.
PARTICLES, PREDICTED = 256, 64
# Repetitions of a move: each draws its own step size.
REPEATED = 8


class MarkovMove(Protocol):
    """A map from a state and its ancestor among `previous` to another such pair, which leaves p(ancestor, state | data) invariant."""

    def __call__(self, key: Key, state: State, ancestor: Index, previous: Particles, density: Density) -> tuple[State, Index]:
        """Apply the move once."""
        ...


def iterated_sir(particles: int = PARTICLES) -> MarkovMove:
    """Return the move of `sir`: the current state competes with `particles` - 1 others that the particle filter predicts and weighs."""

    def move(key: Key, state: State, ancestor: Index, previous: Particles, density: Density) -> tuple[State, Index]:
        ancestor_key, sample_key, choice_key = jax.random.split(key, 3)
        # With systematic resampling the particles would depend on each other, and the move would not be exact.
        rivals = jax.random.categorical(ancestor_key, previous.log_weights, shape=(particles - 1,)).astype(ancestor.dtype)
        density = density.with_previous(previous)
        drawn = predict(sample_key, rivals, density)
        parent = density.ancestor(ancestor)
        weights = jnp.concatenate([density.log_weight(state, parent)[None], drawn.log_weights])
        chosen = jax.random.categorical(choice_key, jnp.where(jnp.isnan(weights), -jnp.inf, weights))
        joined = jax.tree.map(
            lambda current, predicted: jnp.concatenate([jnp.asarray(current)[None], predicted])[chosen], dict(state), dict(drawn.states)
        )
        return joined, jnp.concatenate([ancestor[None], rivals])[chosen]

    return move


def tempered_walk(move: Move, moves: int, candidates: int, repeated: int = REPEATED) -> MarkovMove:
    """Return the move of `tempered`: `repeated` times, redraw the ancestor among `candidates` and move the state `moves` times."""

    def moved(key: Key, state: State, ancestor: Index, previous: Particles, density: Density) -> tuple[State, Index]:
        view = extended(density.with_previous(previous))
        whitening_key, walk_key = jax.random.split(key)
        roots = _roots(whitening_key, view)
        largest = jnp.asarray(move.step_size(sum(root.shape[0] for root in roots.values())))

        def walk_once(particle: ExtendedParticle, turn_key: Key) -> tuple[ExtendedParticle, None]:
            size_key, move_key = jax.random.split(turn_key)
            size = largest * jnp.exp(jax.random.uniform(size_key, (), minval=jnp.log(SCALES[0]), maxval=jnp.log(SCALES[1])))
            settings = MoveSettings(LogTerms(jnp.ones_like(size), jnp.ones_like(size)), size, roots)
            chain, *_ = walk(move_key, particle, view, settings, move, moves, candidates)
            return jax.tree.map(lambda leaf, like: leaf[-1].astype(like.dtype), chain, particle), None

        position = view.coordinates.unconstrain(state)
        start = ExtendedParticle(ancestor, position, view.terms(ancestor, position), jax.tree.map(jnp.zeros_like, position))
        last, _ = jax.lax.scan(walk_once, start, jax.random.split(walk_key, repeated))
        return view.state(last.ancestor, last.position), last.ancestor

    return moved


def move_of_hmc(options: Any, transitions: int = REPEATED) -> MarkovMove:
    """Return the move of `hmc`: `transitions` trajectories on the marginal view, each with its own step size, then an ancestor of the last state."""
    schedule = Schedule(1, 0, 1, options.leapfrog_steps, options.jitter, options.sampler, 0.0)

    def move(key: Key, state: State, ancestor: Index, previous: Particles, density: Density) -> tuple[State, Index]:
        del ancestor
        mass_key, walk_key, ancestor_key = jax.random.split(key, 3)
        density = density.with_previous(previous)
        target = density.unconstrained()
        parent_key, predict_key = jax.random.split(mass_key)
        parent = density.ancestor(jax.random.categorical(parent_key, previous.log_weights))
        fresh = density.transition.sample(predict_key, parent)
        mass = inverse_mass(target, target.unconstrain(fresh), parent)

        def move_once(position: State, turn_key: Key) -> tuple[State, None]:
            step_key, chain_key = jax.random.split(turn_key)
            share = jnp.exp(jax.random.uniform(step_key, (), mass.dtype, jnp.log(SCALES[0]), jnp.log(SCALES[1])))
            chain = run_chain(chain_key, position, target, options.step * share, mass, schedule)
            return jax.tree.map(lambda leaf: leaf[-1], chain.positions), None

        last, _ = jax.lax.scan(move_once, target.unconstrain(state), jax.random.split(walk_key, transitions))
        return target.complete(ancestor_key, last)

    return move


def _roots(key: Key, view: Extended) -> dict[str, Array]:
    """Return the whitening of each variable, from a new prediction."""
    ancestor_key, draw_key = jax.random.split(key)
    density = view.density
    ancestors = jax.random.categorical(ancestor_key, density.previous.log_weights, shape=(PREDICTED,))
    sample = jax.vmap(lambda draw, ancestor: view.coordinates.unconstrain(density.transition.sample(draw, density.ancestor(ancestor))))
    positions = sample(jax.random.split(draw_key, PREDICTED), ancestors)
    return {name: whitening(position, jnp.zeros(PREDICTED, position.dtype)) for name, position in positions.items()}


def move_of_sir(options: Any) -> MarkovMove:
    """Return the move of `sir` with its options."""
    return iterated_sir(min(PARTICLES, max(options.particles, 2)))


def move_of_tempered(options: Any) -> MarkovMove:
    """Return the move of `tempered` with its options."""
    move = hmc(options.leapfrog_steps) if options.move == "hmc" else random_walk()
    return tempered_walk(move, options.moves, options.candidates)
