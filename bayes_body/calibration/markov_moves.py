r"""Markov moves that leave the posterior of a frame exactly as it is: what a kernel is made of, in a form that can be tested without any error.

A kernel with n particles meets the posterior only as n grows. But a truth, the data that it makes and a move whose invariant law is the posterior
given these data have the same joint law before and after the move (Geweke 2004; Gandy & Scott 2020): a test of that has no tolerance to choose.

- `sir`: iterated sampling importance resampling (Andrieu, Lee & Vihola 2018). The present state is one of n particles, the others are predicted and
  weighted as the filter does it, and one of all is drawn by weight: exact for every n ≥ 2.
- `tempered`: its own move at temperature 1, the ancestor redrawn and the state moved in coordinates without limits. Whitening and step size must not
  depend on the state that is moved: the whitening is that of a fresh prediction, the size is drawn anew for each move, between `SCALES` of the
  kernel's own first one, so that some fit however sharp the likelihood is.
- `hmc`: its own transitions on the marginal view, and the ancestor drawn anew from p(i | state). The mass matrix is that at a fresh prediction.
- `annealed` has none: its noise is a proposal that no weight corrects.
"""

from collections.abc import Callable
from typing import Any, Protocol

import jax
import jax.numpy as jnp

from bayes_body.density.factor import FrameDensity, Particles, State
from bayes_body.kernels import particle_filter
from bayes_body.kernels.parts.batching import over_particles
from bayes_body.kernels.parts.extended import Extended, Frame, Moving, bijections, log_likelihood, make_frame, predict, state_of, walk, whitening
from bayes_body.kernels.parts.hamiltonian import Schedule, run_chain
from bayes_body.kernels.parts.mass import inverse_mass
from bayes_body.kernels.parts.moves import Move, hmc, random_walk
from bayes_body.shapes import Index, Key

# Of the size of a step: the smallest and the largest share of the kernel's first one.
SCALES = (0.02, 1.0)
# Particles of an iterated resampling, the present state among them, and predictions from which a whitening is made.
PARTICLES, PREDICTED = 256, 64
# Times that a move is made: each draws its own size of step.
REPEATED = 8


class MarkovMove(Protocol):
    """From a state and its ancestor among `previous` to others, by a law that keeps p(ancestor, state | data)."""

    def __call__(self, key: Key, state: State, ancestor: Index, previous: Particles, density: FrameDensity) -> tuple[State, Index]:
        """One application."""
        ...


def markov_move(kind: str, options: Any) -> MarkovMove | None:
    """The move of a kernel, or None where it has none.

    Args:
        kind: the kernel's name.
        options: as its schema has them.
    """
    return _MOVES[kind](options) if kind in _MOVES else None


def iterated_sir(particles: int = PARTICLES) -> MarkovMove:
    """The present state against `particles` - 1 rivals that the particle filter predicts and weighs."""

    def move(key: Key, state: State, ancestor: Index, previous: Particles, density: FrameDensity) -> tuple[State, Index]:
        ancestor_key, sample_key, choice_key = jax.random.split(key, 3)
        # Independent draws: a systematic resampling would tie the rivals to each other, and that is not exact.
        rivals = jax.random.categorical(ancestor_key, previous.log_weights, shape=(particles - 1,)).astype(ancestor.dtype)
        parents = jax.tree.map(lambda leaf: leaf[rivals], previous.states)
        keys = jax.random.split(sample_key, particles - 1)
        states, log_likelihoods, log_constraints = over_particles(particle_filter._predict_and_weigh, (keys, parents), density)
        own = jax.tree.map(lambda leaf: leaf[ancestor], previous.states)
        weight = density.log_likelihood(state, own) + density.log_constraint(state, own)
        weights = jnp.concatenate([weight[None], log_likelihoods + log_constraints])
        chosen = jax.random.categorical(choice_key, jnp.where(jnp.isnan(weights), -jnp.inf, weights))
        joined = jax.tree.map(lambda one, more: jnp.concatenate([jnp.asarray(one)[None], more])[chosen], dict(state), dict(states))
        return joined, jnp.concatenate([ancestor[None], rivals])[chosen]

    return move


def tempered_walk(move: Move, moves: int, candidates: int, repeated: int = REPEATED) -> MarkovMove:
    """The ancestor redrawn among `candidates` and the state moved `moves` times, `repeated` times over."""

    def moved(key: Key, state: State, ancestor: Index, previous: Particles, density: FrameDensity) -> tuple[State, Index]:
        frame = make_frame(density, previous)
        whitening_key, walk_key = jax.random.split(key)
        roots = _roots(whitening_key, frame)
        largest = jnp.asarray(move.scale(sum(root.shape[0] for root in roots.values())))

        def again(particle: Extended, own: Key) -> tuple[Extended, None]:
            scale_key, move_key = jax.random.split(own)
            scale = largest * jnp.exp(jax.random.uniform(scale_key, (), minval=jnp.log(SCALES[0]), maxval=jnp.log(SCALES[1])))
            chain, _ = walk(move_key, particle, frame, Moving(jnp.ones_like(scale), scale, roots), move, moves, candidates)
            return jax.tree.map(lambda leaf, before: leaf[-1].astype(before.dtype), chain, particle), None

        position = {name: jnp.asarray(bijection.inv(state[name])) for name, bijection in bijections(frame).items()}
        start = Extended(ancestor, position, log_likelihood(frame, ancestor, position))
        last, _ = jax.lax.scan(again, start, jax.random.split(walk_key, repeated))
        return state_of(frame, last.ancestor, last.position), last.ancestor

    return moved


def hmc_walk(options: Any, transitions: int = REPEATED) -> MarkovMove:
    """So many trajectories on the marginal view, each of its own size of step, and an ancestor of where they end."""
    schedule = Schedule(1, 0, 1, options.leapfrog_steps, options.jitter, options.sampler, 0.0)

    def move(key: Key, state: State, ancestor: Index, previous: Particles, density: FrameDensity) -> tuple[State, Index]:
        del ancestor
        mass_key, walk_key, ancestor_key = jax.random.split(key, 3)
        density = density.given(previous)
        target = density.unconstrained()
        parent_key, predict_key = jax.random.split(mass_key)
        parent = density.ancestor(jax.random.categorical(parent_key, previous.log_weights))
        fresh = density.transition.sample(predict_key, parent)
        mass = inverse_mass(target, target.unconstrain({name: fresh[name] for name in target.bijections}), parent)

        def again(position: State, own: Key) -> tuple[State, None]:
            step_key, chain_key = jax.random.split(own)
            share = jnp.exp(jax.random.uniform(step_key, (), mass.dtype, jnp.log(SCALES[0]), jnp.log(SCALES[1])))
            chain = run_chain(chain_key, position, target, options.step * share, mass, schedule)
            return jax.tree.map(lambda leaf: leaf[-1], chain.positions), None

        start = target.unconstrain({name: state[name] for name in target.bijections})
        last, _ = jax.lax.scan(again, start, jax.random.split(walk_key, transitions))
        sampled = target.constrain(last)
        chosen = jax.random.categorical(ancestor_key, density.ancestor_log_probs(sampled, target.predictions))
        return density.transition.carry(density.ancestor(chosen), sampled), chosen

    return move


def _roots(key: Key, frame: Frame) -> dict[str, Any]:
    """The whitening of a prediction of its own, variable by variable."""
    ancestor_key, draw_key = jax.random.split(key)
    ancestors = jax.random.categorical(ancestor_key, frame.previous.log_weights, shape=(PREDICTED,))
    predicted, _, _ = jax.vmap(predict, (0, 0, None))(jax.random.split(draw_key, PREDICTED), ancestors, frame)
    return {name: whitening(position, jnp.zeros(PREDICTED, position.dtype)) for name, position in predicted.position.items()}


def _sir(options: Any) -> MarkovMove:
    return iterated_sir(min(PARTICLES, max(options.particles, 2)))


def _tempered(options: Any) -> MarkovMove:
    move = hmc(options.leapfrog_steps) if options.move == "hmc" else random_walk()
    return tempered_walk(move, options.moves, options.candidates)


_MOVES: dict[str, Callable[[Any], MarkovMove]] = {"sir": _sir, "tempered": _tempered, "hmc": hmc_walk}
