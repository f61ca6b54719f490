r"""The backward step of the ensemble Rauch-Tung-Striebel smoother (Raanes 2016), in unconstrained coordinates.

Let $u_i$ be the coordinates of a particle of the frame before, and $v_i$ the coordinates of the next frames, drawn from the motion prior given this
particle. A path whose next frames are at $v$ continues backwards from a particle $i$, drawn by its weight, at

$$u = u_i + K (v - v_i), \qquad K = \mathrm{Cov}(u, v)\, \mathrm{Cov}(v, v)^{-1}.$$

If everything is normal, $u$ is a draw from its distribution given the next frames and the images so far. Unlike a particle, it can lie anywhere, so
paths do not share their past.
"""

from collections.abc import Callable, Mapping
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool, Float, Int

from bayes_body.base.shapes import Index, Key
from bayes_body.density.ahead import Ahead, sampled_of
from bayes_body.density.chart import Chart
from bayes_body.density.factor import Particles, State, Transition
from bayes_body.kernels.batching import over_particles
from bayes_body.kernels.smc.moves import shrunk

# The least number of predictions, of all particles together, with noise of their own. They give the covariance of the noise.
PREDICTIONS = 2000
# For each of these, the number of predictions with the same noise for all particles. They give the slope, in which common noise is no error. Near the
# limit of a joint the slope depends on the noise. With one instead of four, the runs of a smoother differed more there.
ALIKE = 4
# Particles in a batch; a prediction is little work.
BATCH = 64


class LinearPrediction(NamedTuple):
    r"""The next frames given a state, by regression: $v = B u + e$.

    Attributes:
        spread: covariance C of u.
        slope: B.
        noise: covariance S of e.
    """

    spread: Float[Array, "size size"]
    slope: Float[Array, "all_sizes size"]
    noise: Float[Array, "all_sizes all_sizes"]

    def nearest(self) -> "LinearPrediction":
        """Return the regression of the nearest next frame alone."""
        size = len(self.spread)
        return LinearPrediction(self.spread, self.slope[:size], self.noise[:size, :size])

    def of_known(self, exists: Bool[Array, " frame"]) -> "LinearPrediction":
        """Return the regression without weight on next frames that do not exist, so that one program serves all frames of a recording."""
        rows = jnp.repeat(exists, len(self.spread))
        noise = jnp.where(rows[:, None] & rows, self.noise, jnp.eye(len(rows), dtype=self.noise.dtype))
        return LinearPrediction(self.spread, jnp.where(rows[:, None], self.slope, 0.0), noise)

    def gain(self) -> Float[Array, "size all_sizes"]:
        """Return K of the regression of u on v."""
        return jnp.linalg.solve(self.slope @ self.spread @ self.slope.T + self.noise, self.slope @ self.spread).T

    def precision_between(self) -> Float[Array, "size size"]:
        r"""Return approximately the precision of u given the frames before and after, for one next frame: $C^{-1} + S^{-1} + B^\top S^{-1} B$.

        The first term contains what the images say, and a part of what the frame before says. This part is counted twice.
        """
        precision = _inverse(self.noise)
        return _inverse(self.spread) + precision + self.slope.T @ precision @ self.slope


class Flat(NamedTuple):
    """The maps from sampled variables to vectors of coordinates and back. A freely turning dof is unwound to near the particles' mean."""

    unwound: Callable[[State], State]
    vector: Callable[[State], Array]
    sampled: Callable[[Array], dict[str, Array]]
    transition: Transition

    def vector_of_state(self, state: State) -> Array:
        """Return the coordinates of a whole state."""
        return self.vector(sampled_of(self.transition, self.unwound(state)))


def regressed(
    key: Key, particles: Particles, indices: Int[Array, " path"], nexts: Ahead, transition: Transition, chart: Chart, prediction: LinearPrediction
) -> dict[str, Array]:
    """Return the sampled variables of each path in the frame before (path, ...).

    Args:
        key: random key of the predictions.
        particles: the particles of the frame before.
        indices: the particle from which each path continues.
        nexts: the next frames of each path, the nearest first (path, frame, ...); all paths have the same number.
        transition: the motion prior.
        chart: the unconstrained coordinates.
        prediction: the regression (`linear_prediction`).
    """
    flat, frames = flat_coordinates(particles, transition, chart), len(prediction.slope) // len(prediction.spread)
    chosen = jax.tree.map(lambda leaf: leaf[indices], dict(particles.states))
    unwound = jax.vmap(flat.unwound)(chosen)
    u = jax.vmap(flat.vector_of_state)(chosen)
    v = jax.vmap(lambda key, state: _predicted(key, state, transition, chart, frames))(jax.random.split(key, len(indices)), unwound)
    next_vectors = jax.vmap(jax.vmap(flat.vector))(nexts.sampled).reshape(v.shape)
    return jax.vmap(flat.sampled)(u + (next_vectors - v) @ prediction.of_known(nexts.exists[0]).gain().T)


def linear_prediction(key: Key, particles: Particles, transition: Transition, chart: Chart, frames: int) -> LinearPrediction:
    """Return the regression of the next `frames` frames on the particles, in the order of `ravel_pytree` over a position's variables.

    With few particles, a regression of u on v would find too small a gain in every coordinate, and chance correlations between all of them. So B
    comes from predictions with the same noise for all particles, which leaves the noise out of B. The correlations of C and S are shrunk, less if
    there are more particles.
    """
    flat, weights, count = flat_coordinates(particles, transition, chart), jax.nn.softmax(particles.log_weights), particles.log_weights.shape[0]
    repeats = -(-PREDICTIONS // count)
    unwound = jax.vmap(flat.unwound)(dict(particles.states))

    def predictions(item: tuple[Key, State], shared: tuple[Transition, Chart, Key]) -> tuple[Array, Array]:
        (keys, state), (transition, chart, common) = item, shared
        draw = jax.vmap(lambda key: _predicted(key, state, transition, chart, frames))
        if frames == 1:
            # In a call of their own, the random numbers of common keys are drawn once for all particles.
            return draw(keys), jnp.mean(draw(common), axis=0)
        # In one call, the program holds the motion prior once.
        drawn = draw(jnp.concatenate([keys, common]))
        return drawn[:repeats], jnp.mean(drawn[repeats:], axis=0)

    own_key, common_key = jax.random.split(key)
    keys = jax.random.split(own_key, (count, repeats)), jax.random.split(common_key, ALIKE * repeats)
    u = jax.vmap(lambda state: flat.vector(sampled_of(transition, state)))(unwound)
    predicted, common = over_particles(predictions, (keys[0], unwound), (transition, chart, keys[1]), BATCH)
    size = u.shape[1]
    u -= weights @ u
    share = (size / (size + 1 / jnp.sum(weights**2))) ** 2
    spread = shrunk((weights[:, None] * u).T @ u, share)
    # The slope of a random walk is the identity. Only the difference from it is estimated.
    excess = common - jnp.tile(u, frames)
    cross = (weights[:, None] * (excess - weights @ excess)).T @ u
    slope = jnp.tile(jnp.eye(size, dtype=u.dtype), (frames, 1)) + jnp.linalg.solve(spread, cross.T).T
    noise = predicted - (u @ slope.T)[:, None]
    noise -= jnp.mean(weights @ noise.swapaxes(0, 1), axis=0)
    weighted = (weights[:, None, None] * noise).reshape(count * repeats, -1)
    return LinearPrediction(spread, slope, shrunk(weighted.T @ noise.reshape(count * repeats, -1) / repeats, share))


def flat_coordinates(particles: Particles, transition: Transition, chart: Chart) -> Flat:
    """Return the maps between states and coordinates near a frame's particles."""
    first = jax.tree.map(lambda leaf: leaf[0], dict(particles.states))
    _, unravel = ravel_pytree(chart.unconstrain(first))
    weights, drawn = jax.nn.softmax(particles.log_weights), jax.vmap(lambda state: sampled_of(transition, state))(particles.states)
    centre = {name: jnp.asarray(transition.space(name, leaf.shape[1:]).mean(weights, leaf)) for name, leaf in drawn.items()}

    def unwind(sampled: State) -> State:
        return transition.near(sampled, centre)

    return Flat(
        lambda state: {**state, **unwind(sampled_of(transition, state))},
        lambda sampled: ravel_pytree(chart.unconstrain(unwind(sampled)))[0],
        lambda row: chart.constrain(unravel(row)),
        transition,
    )


def _predicted(key: Key, state: State, transition: Transition, chart: Chart, frames: int) -> Array:
    """Draw the coordinates of the next frames of a state."""

    def step(state: State, number: Index) -> tuple[State, Array]:
        state = dict(transition.sample(jax.random.fold_in(key, number), state))
        return state, ravel_pytree(chart.unconstrain(sampled_of(transition, state)))[0]

    if frames == 1:
        # Outside a loop, the part that all draws from one state share is computed once.
        return step(dict(state), jnp.zeros((), jnp.int32))[1]
    return jax.lax.scan(step, dict(state), jnp.arange(frames))[1].ravel()


def _inverse(covariance: Float[Array, "size size"]) -> Float[Array, "size size"]:
    """Return the inverse of a covariance whose entries may have very different units."""
    sd = jnp.sqrt(jnp.diagonal(covariance))
    units = sd[:, None] * sd
    return jnp.linalg.inv(covariance / units) / units


def replaced(particles: Particles, indices: Int[Array, " path"], sampled: Mapping[str, Array], transition: Transition) -> dict[str, Array]:
    """Return the particles of the paths as whole states, with new sampled variables and the variables derived from these."""
    states = jax.tree.map(lambda leaf: leaf[indices], dict(particles.states))
    return {**states, **jax.vmap(transition.with_derived)(sampled)}
