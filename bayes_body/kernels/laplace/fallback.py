"""What samples a frame that the importance weights of `laplace` cannot do: tempered SMC, with the same prediction."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from bayes_body.base.shapes import Key, Scalar
from bayes_body.density.density import Density
from bayes_body.density.factor import Particles
from bayes_body.density.gaussian_view import GaussianView, gaussian_view
from bayes_body.density.kernel import FilterInfo, Kernel
from bayes_body.kernels.batching import one_device, over_particles
from bayes_body.kernels.smc import tempered_smc
from bayes_body.kernels.weights import normalise

# Its options.
TEMPERED = {"prediction": "gaussian", "move": "hmc", "moves": 1, "leapfrog_steps": 5, "target_ess": 0.3, "final_stages": 4}
# The number of this attempt: after the first one, and the one from more starts.
ATTEMPT = 2


def build_fallback() -> Kernel:
    """Return the kernel, whose figures have the shapes of those of `laplace`."""
    tempered = tempered_smc.build_kernel(**TEMPERED)

    def kernel(key: Key, particles: Particles, density: Density) -> tuple[Particles, FilterInfo]:
        # Keys as in the first kernel: the same view, and random numbers that it has not used.
        view_key, _, _, key = jax.random.split(key, 4)
        share_key, key = jax.random.split(key)
        # Otherwise it would need another layout where it is a part of the program of `laplace`.
        with one_device():
            sampled, info = tempered(key, particles, density)
            view = gaussian_view(view_key, density.with_previous(particles))
            log_allowed = _log_allowed(share_key, view, sampled.log_weights.shape[0])
        return sampled, info._replace(
            survival_rate=(info.ess / sampled.log_weights.shape[0])[None],
            inverse_temperatures=jnp.ones((1,), info.ess.dtype),
            # The evidence of `tempered` is relative to the prediction inside the constraints.
            log_evidence=info.log_evidence + log_allowed,
            acceptance_rate=jnp.nanmean(info.acceptance_rate)[None],
            modes={"attempt": jnp.full((), ATTEMPT, jnp.int32)},
        )

    return kernel


def _log_allowed(key: Key, view: GaussianView, count: int) -> Scalar:
    """Return the log of the mean of the constraints and potentials over the prediction."""

    def log_allowed(z: Float[Array, " dof"], view: GaussianView) -> Scalar:
        state, previous = view.state_at(z), view.density.ancestor(0)
        return view.density.log_constraint(state, previous) + view.density.log_potential(state, previous)

    drawn = jax.random.normal(key, (count, view.mean.shape[0]), view.mean.dtype)
    return normalise(over_particles(log_allowed, drawn, view)).log_sum - jnp.log(count)
