r"""The particle filter, by sampling importance resampling (Gordon, Salmond & Smith 1993), on the extended view.

$$i \sim w, \qquad s_t \sim p(s_t \mid s^i_{t-1}), \qquad w_t \propto L(s_t; z_t)\, C(s_t), \qquad
\hat p(z_t \mid z_{1:t-1}) = \frac{\sum_n L(s^n_t)\, C(s^n_t)}{\sum_n C(s^n_t)}.$$

The particles are a weighted sample of the posterior. The constraints C cut a part off the prediction, which the denominator divides out; without
constraints it is N and the estimate of the evidence is unbiased. With 31 dofs and a sharp likelihood few particles survive a frame: the price of
sampling from the prior.
"""

from typing import Any

import jax
import jax.numpy as jnp

from bayes_body.density.factor import FilterInfo, FrameDensity, Kernel, Particles, State
from bayes_body.kernels.parts.batching import over_particles
from bayes_body.kernels.parts.resampling import Scheme, resampler
from bayes_body.kernels.parts.weights import effective_sample_size, normalise
from bayes_body.registry import register
from bayes_body.shapes import Key, Scalar
from bayes_body.toml.read import validate
from bayes_body.toml.schema import Count, Schema


class Options(Schema):
    """Options of `[kernel] kind = "sir"`."""

    particles: Count = 4000
    resampling: Scheme = "systematic"


def build_kernel(resampling: Scheme = "systematic") -> Kernel:
    """One frame of the filter; the number of particles is that of the particles given to it.

    Raises:
        InputError: there is no such resampling scheme.
    """
    validate(Options, {"resampling": resampling}, "sir()")
    resample = resampler(resampling)

    def kernel(key: Key, particles: Particles, density: FrameDensity) -> tuple[Particles, FilterInfo]:
        resampling_key, sampling_key = jax.random.split(key)
        ancestors = resample(resampling_key, particles.log_weights)
        previous = jax.tree.map(lambda leaf: leaf[ancestors], particles.states)
        keys = jax.random.split(sampling_key, ancestors.shape[0])
        states, log_likelihoods, log_constraints = over_particles(_predict_and_weigh, (keys, previous), density)
        weights = normalise(log_likelihoods + log_constraints)
        ess = effective_sample_size(weights.log_weights)
        info = FilterInfo(
            ancestors=ancestors,
            ess=ess,
            survival_rate=(ess / ancestors.shape[0])[None],
            inverse_temperatures=jnp.ones((1,), ess.dtype),
            log_evidence=weights.log_sum - normalise(log_constraints).log_sum,
            lost=weights.lost,
            acceptance_rate=jnp.full((1,), jnp.nan, ess.dtype),
            evaluations=jnp.asarray(ancestors.shape[0]),
        )
        return Particles(states, weights.log_weights), info

    return kernel


def _predict_and_weigh(particle: tuple[Key, State], density: FrameDensity) -> tuple[State, Scalar, Scalar]:
    key, previous = particle
    # Without the barrier XLA draws the noise anew wherever the state is read.
    state = jax.lax.optimization_barrier(density.transition.sample(key, previous))
    return state, density.log_likelihood(state, previous), density.log_constraint(state, previous)


@register("kernel", "sir", Options)
def build(options: Options, **_: Any) -> Kernel:
    """The kernel of a definition."""
    return build_kernel(options.resampling)
