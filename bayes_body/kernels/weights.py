r"""Log-weights, weighted draws from the prediction, and resampling.

ESS $= 1 / \sum_i \pi_i^2$ for normalised $\pi$; survival rate = ESS / N (Deutscher & Reid 2005).

The resampling schemes are those of blackjax. Each draws ancestors of particles by weight. All are unbiased; they differ in variance.
"""

from collections.abc import Callable
from typing import Literal, NamedTuple, Protocol, cast

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from bayes_body.base.shapes import Flag, Index, Key, Scalar
from bayes_body.density.density import Density
from bayes_body.density.factor import State
from bayes_body.density.gaussian_view import GaussianView, gaussian_view
from bayes_body.kernels.batching import over_particles

type LogWeights = Float[Array, " particle"]


class Normalised(NamedTuple):
    """Normalised log-weights, the log of the weights' sum before normalisation, and whether that sum was zero or not finite."""

    log_weights: LogWeights
    log_sum: Scalar
    lost: Flag


def normalise(log_weights: LogWeights) -> Normalised:
    """Normalise log-weights. NaN counts as zero weight. If all weights are zero, they become equal and `lost` is set; then keep the prediction."""
    clean = jnp.where(jnp.isnan(log_weights), -jnp.inf, log_weights)
    # The peak is subtracted first: the log-likelihood of a whole image is some thousands, which leaves no digits of 32 bits for the log of the sum.
    peak = jnp.max(clean)
    relative = clean - jnp.where(jnp.isfinite(peak), peak, 0.0)
    log_ratio = jax.nn.logsumexp(relative)
    lost = ~jnp.isfinite(log_ratio)
    equal = jnp.full_like(clean, -jnp.log(clean.shape[0]))
    return Normalised(jnp.where(lost, equal, relative - jnp.where(lost, 0.0, log_ratio)), jnp.where(lost, log_ratio, peak + log_ratio), lost)


def effective_sample_size(log_weights: LogWeights) -> Scalar:
    """Return the effective sample size, in particles, of normalised or unnormalised log-weights."""
    weights = jnp.exp(log_weights - jnp.max(log_weights))
    return jnp.sum(weights) ** 2 / jnp.sum(weights * weights)


class Weighed(NamedTuple):
    """Proposed states and the terms of their log-weights. Leaves have a leading particle axis, or none."""

    states: State
    log_likelihoods: Float[Array, "*particle"]
    log_constraints: Float[Array, "*particle"]
    log_potentials: Float[Array, "*particle"]

    @property
    def log_weights(self) -> Float[Array, "*particle"]:
        """The log-weights L C ψ."""
        return self.log_likelihoods + self.log_constraints + self.log_potentials

    def normalised(self) -> Normalised:
        """Return the normalised weights of all particles."""
        return normalise(self.log_weights)

    def log_evidence(self) -> Scalar:
        """Return log(sum of L C ψ / sum of C ψ), the evidence relative to the constrained prediction."""
        return self.normalised().log_sum - normalise(self.log_constraints + self.log_potentials).log_sum


def weigh(state: State, previous: State, density: Density) -> Weighed:
    """Return one proposed state with the terms of its log-weight."""
    # Without the barrier, XLA repeats the draw of the noise wherever the state is read.
    state = jax.lax.optimization_barrier(state)
    constraint, potential = density.log_constraint(state, previous), density.log_potential(state, previous)
    return Weighed(state, density.log_likelihood(state, previous), constraint, potential)


def predict(key: Key, ancestors: Int[Array, " particle"], density: Density) -> Weighed:
    """Draw one weighted state from the motion prior for each of these ancestors.

    Args:
        key: random key.
        ancestors: indices among the previous frame's particles in the density.
        density: the density of the frame.
    """
    keys = jax.random.split(key, ancestors.shape[0])
    return over_particles(_predict_one, (keys, ancestors), density)


def _predict_one(key_and_ancestor: tuple[Key, Index], density: Density) -> Weighed:
    key, ancestor = key_and_ancestor
    previous = density.ancestor(ancestor)
    return weigh(density.transition.sample(key, previous), previous, density)


def predict_by_gaussian(key: Key, indices: Int[Array, " particle"], density: Density) -> tuple[GaussianView, Weighed]:
    """Return the Gaussian view of the prediction, and a weighted draw from it for each index.

    Args:
        key: random key.
        indices: for each draw a particle of the previous frame, from which the state takes the variables that are not sampled.
        density: the density of the frame.

    Raises:
        InputError: a Gaussian cannot predict this model's states (`gaussian_view`).
    """
    fit_key, draw_key = jax.random.split(key)
    view = gaussian_view(fit_key, density)

    def weighed(noise_and_index: tuple[Array, Index], view: GaussianView) -> Weighed:
        noise, index = noise_and_index
        unread, read = noise[: view.unread_size], noise[view.unread_size :]
        return weigh(view.completed(unread, index, view.draw(read)), view.density.ancestor(index), view.density)

    noise = jax.lax.optimization_barrier(jax.random.normal(draw_key, (indices.shape[0], view.unread_size + view.mean.shape[0]), view.mean.dtype))
    return view, over_particles(weighed, (noise, indices), view)


type Scheme = Literal["systematic", "stratified", "multinomial", "residual"]


class Resample(Protocol):
    """A function from log-weights (normalised or not) to ancestors: as many as there are weights, or `count`."""

    def __call__(self, key: Key, log_weights: Float[Array, " particle"], count: int | None = None) -> Int[Array, " drawn"]: ...  # noqa: D102


def resampler(scheme: Scheme) -> Resample:
    """Return a scheme by name.

    Args:
        scheme: `systematic` and `stratified` spread the draws evenly, `residual` keeps the integer parts of N w, `multinomial` draws independently.
    """
    import blackjax.smc.resampling as schemes

    # blackjax declares no types for its resampling functions, so they are cast once, here.
    function = cast(Callable[[Key, Array, int], Array], getattr(schemes, scheme))

    def resample(key: Key, log_weights: Float[Array, " particle"], count: int | None = None) -> Int[Array, " drawn"]:
        weights = jnp.exp(log_weights - jnp.max(log_weights))
        return function(key, weights / jnp.sum(weights), log_weights.shape[0] if count is None else count)

    return resample
