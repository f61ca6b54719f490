r"""The step back in time of the ensemble Rauch-Tung-Striebel smoother (Raanes 2016), in unconstrained coordinates.

Let $u_i$ be the coordinates of a particle of the frame before, and $v_i$ those of the next frames, drawn from the motion prior given it. A path whose
next frames are at $v$ continues backwards from a particle $i$, drawn by its weight, at

$$u = u_i + K (v - v_i), \qquad K = \mathrm{Cov}(u, v)\, \mathrm{Cov}(v, v)^{-1}.$$

If everything is normal, $u$ is a draw from its distribution given the next frames and the images so far. Unlike one of the particles, it can lie
anywhere: paths do not share their past.
"""

from collections.abc import Callable, Mapping
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float, Int

from bayes_body.density.ahead import Ahead, sampled_of
from bayes_body.density.chart import Chart
from bayes_body.density.factor import Particles, State, Transition
from bayes_body.kernels.parts.moves import shrunk
from bayes_body.kernels.parts.weights import LogWeights
from bayes_body.shapes import Key

# Predictions of all particles together, at least. The regression has the same error for all paths of a run, and with 2000 the runs differed more.
PREDICTIONS = 8000


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

    def gain(self) -> Float[Array, "size all_sizes"]:
        """Return K of the regression of u on v."""
        return jnp.linalg.solve(self.slope @ self.spread @ self.slope.T + self.noise, self.slope @ self.spread).T

    def precision_between(self) -> Float[Array, "size size"]:
        r"""Return about the precision of u given the frames before and after: $C^{-1} + S^{-1} + B^\top S^{-1} B$, of one next frame.

        The first counts what the images say, and a part of what the frame before says, which is so counted twice.
        """
        precision = _inverse(self.noise)
        return _inverse(self.spread) + precision + self.slope.T @ precision @ self.slope


class _Drawn(NamedTuple):
    """Coordinates of the particles, of their predictions, what makes a vector of sampled variables, and what makes coordinates of a vector."""

    u: Float[Array, "particle size"]
    v: Float[Array, "repeat particle all_sizes"]
    flat: Callable[[State], Array]
    unravel: Callable[[Array], State]


def regressed(
    key: Key, particles: Particles, indices: Int[Array, " path"], nexts: Ahead, transition: Transition, chart: Chart, frames: int
) -> dict[str, Array]:
    """Return the sampled variables of each path in the frame before (path, ...).

    Args:
        key: random key of the predictions.
        particles: the particles of the frame before.
        indices: the particle from which each path continues.
        nexts: the next frames of each path, the nearest first (path, frame, ...).
        transition: the motion prior.
        chart: the unconstrained coordinates.
        frames: how many next frames of the paths are known, at least one; as many are used.
    """
    u, v, flat, unravel = _drawn(key, particles, transition, chart, frames)
    gain = _linear(u, v, particles.log_weights).gain()
    known = [jax.vmap(lambda path, k=k: flat({name: values[k] for name, values in path.items()}))(nexts.sampled) for k in range(frames)]
    moved = u[indices] + (jnp.concatenate(known, axis=1) - v[0][indices]) @ gain.T
    return jax.vmap(lambda row: chart.constrain(unravel(row)))(moved)


def linear_prediction(key: Key, particles: Particles, transition: Transition, chart: Chart) -> LinearPrediction:
    """Return the regression of the next frame on the particles, in the order of `ravel_pytree` over a position's variables."""
    u, v, *_ = _drawn(key, particles, transition, chart, 1)
    return _linear(u, v, particles.log_weights)


def _drawn(key: Key, particles: Particles, transition: Transition, chart: Chart, frames: int) -> _Drawn:
    """Draw the next frames of the particles."""
    first = jax.tree.map(lambda leaf: leaf[0], dict(particles.states))
    _, unravel = ravel_pytree(chart.unconstrain(first))
    weights, drawn = jax.nn.softmax(particles.log_weights), jax.vmap(lambda state: sampled_of(transition, state))(particles.states)
    centre = {name: jnp.asarray(transition.space(name, leaf.shape[1:]).mean(weights, leaf)) for name, leaf in drawn.items()}

    def near(sampled: State) -> State:
        return transition.near(sampled, centre)

    def flat(sampled: State) -> Array:
        return ravel_pytree(chart.unconstrain(near(sampled)))[0]

    def predicted(key: Key, state: State) -> Array:
        found = []
        for step in range(frames):
            state = transition.sample(jax.random.fold_in(key, step), state)
            found.append(ravel_pytree(chart.unconstrain(sampled_of(transition, state)))[0])
        return jnp.concatenate(found)

    unwound = jax.vmap(near)(drawn)
    count = particles.log_weights.shape[0]
    keys = jax.random.split(key, (-(-PREDICTIONS // count), count))
    v = jax.vmap(lambda some: jax.vmap(predicted)(some, {**particles.states, **unwound}))(keys)
    return _Drawn(jax.vmap(flat)(drawn), v, flat, unravel)


def _linear(u: Float[Array, "particle size"], v: Float[Array, "repeat particle all_sizes"], log_weights: LogWeights) -> LinearPrediction:
    """Return the regression of v on u.

    A regression of u on v with few particles would find too small a gain in every coordinate, and chance correlations between all of them. B comes
    from all repeats together, and the correlations of C and S are shrunk, the less the more particles there are.
    """
    weights, size = jax.nn.softmax(log_weights), u.shape[1]
    mean_u, mean_v = weights @ u, jnp.mean(weights @ v, axis=0)
    covariance = (weights[:, None] * (u - mean_u)).T @ (u - mean_u)
    # The slope beyond that of a random walk, which is known to be one.
    rest = v - jnp.tile(u, v.shape[2] // size)
    cross = jnp.mean(jnp.einsum("p,rpv,pu->rvu", weights, rest - jnp.mean(weights @ rest, axis=0), u - mean_u), axis=0)
    share = (size / (size + 1 / jnp.sum(weights**2))) ** 2
    spread = shrunk(covariance, share)
    slope = jnp.tile(jnp.eye(size, dtype=u.dtype), (v.shape[2] // size, 1)) + jnp.linalg.solve(spread, cross.T).T
    noise = v - mean_v - (u - mean_u) @ slope.T
    residual = shrunk(jnp.mean(jnp.einsum("p,rpa,rpb->rab", weights, noise, noise), axis=0), share)
    return LinearPrediction(spread, slope, residual)


def _inverse(covariance: Float[Array, "size size"]) -> Float[Array, "size size"]:
    """Return the inverse of a covariance whose entries may have very different units."""
    sd = jnp.sqrt(jnp.diagonal(covariance))
    units = sd[:, None] * sd
    return jnp.linalg.inv(covariance / units) / units


def replaced(particles: Particles, indices: Int[Array, " path"], sampled: Mapping[str, Array], transition: Transition) -> dict[str, Array]:
    """Return the particles of the paths as whole states, with other sampled variables and what follows from these."""
    kept = jax.tree.map(lambda leaf: leaf[indices], dict(particles.states))
    return {**kept, **jax.vmap(transition.with_derived)(sampled)}
