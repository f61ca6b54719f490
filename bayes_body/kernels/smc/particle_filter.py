r"""The particle filter, by sampling importance resampling (Gordon, Salmond & Smith 1993), on the extended view.

$$i \sim w, \qquad s_t \sim p(s_t \mid s^i_{t-1}), \qquad w_t \propto L(s_t; z_t)\, C(s_t), \qquad
\hat p(z_t \mid z_{1:t-1}) = \frac{\sum_n L(s^n_t)\, C(s^n_t)}{\sum_n C(s^n_t)}.$$

The particles are a weighted sample of the posterior. The constraints C remove a part of the prediction, and the denominator normalises the rest.
Without constraints the denominator is N, and the estimate of the evidence is unbiased. The filter samples from the prior, so with 31 dofs and a sharp
likelihood few particles survive a frame.
"""

from typing import Any

import jax
import jax.numpy as jnp

from bayes_body.base.registry import register
from bayes_body.base.shapes import Key
from bayes_body.base.toml.read import validate
from bayes_body.base.toml.schema import Count, Schema
from bayes_body.density.density import Density
from bayes_body.density.factor import Particles
from bayes_body.density.kernel import FilterInfo, Kernel
from bayes_body.kernels.weights import Scheme, effective_sample_size, predict, resampler


class Options(Schema):
    """Options of `[kernel] kind = "sir"`."""

    particles: Count = 4000
    """[particles] per run."""
    resampling: Scheme = "systematic"
    """how ancestors are drawn: `"systematic"`, `"stratified"`, `"multinomial"` or `"residual"`."""


def build_kernel(resampling: Scheme = "systematic") -> Kernel:
    """Return a kernel that filters one frame. It returns as many particles as it is given.

    Raises:
        InputError: there is no such resampling scheme.
    """
    validate(Options, {"resampling": resampling}, "sir()")
    resample = resampler(resampling)

    def kernel(key: Key, particles: Particles, density: Density) -> tuple[Particles, FilterInfo]:
        resampling_key, sampling_key = jax.random.split(key)
        ancestors = resample(resampling_key, particles.log_weights)
        drawn = predict(sampling_key, ancestors, density.with_previous(particles))
        weights = drawn.normalised()
        ess = effective_sample_size(weights.log_weights)
        info = FilterInfo(
            ancestors=ancestors,
            ess=ess,
            survival_rate=(ess / ancestors.shape[0])[None],
            inverse_temperatures=jnp.ones((1,), ess.dtype),
            log_evidence=drawn.log_evidence(),
            lost=weights.lost,
            acceptance_rate=jnp.full((1,), jnp.nan, ess.dtype),
            evaluations=jnp.asarray(ancestors.shape[0]),
        )
        return Particles(drawn.states, weights.log_weights), info

    return kernel


def _markov_move(options: Options) -> Any:
    # The move is built from this kernel's parts, so it is imported only when needed.
    from bayes_body.kernels.markov_moves import move_of_sir

    return move_of_sir(options)


@register("kernel", "sir", Options, samples_posterior=True, markov_move=_markov_move, instead="use --kernel tempered", by_particles=True)
def build(options: Options, **_: Any) -> Kernel:
    """Build the kernel from a definition's options."""
    return build_kernel(options.resampling)
