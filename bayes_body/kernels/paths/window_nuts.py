"""Chains of the No-U-Turn sampler (Hoffman & Gelman 2014) with Stan's window adaptation, by blackjax.

blackjax declares no types for these functions, so they are cast once, here.
"""

from collections.abc import Callable
from typing import Any, Literal, NamedTuple, cast

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from bayes_body.base.shapes import Key, Scalar
from bayes_body.kernels.batching import over_particles
from bayes_body.kernels.hmc.hamiltonian import DIVERGENCE, DOUBLINGS

type Metric = Literal["diagonal", "dense", "low_rank"]

# Largest rank of the correction of a low-rank metric.
RANK = 20


class NutsSchedule(NamedTuple):
    """The settings of chains: numbers of transitions in warm-up and after it, and the metric and the acceptance rate to which warm-up adapts."""

    warm_up: int
    draws: int
    metric: Metric
    target_acceptance: float


class _Centre(NamedTuple):
    """The part of a low-rank adaptation that blackjax reads after warm-up."""

    mu_star: Any


class _WarmUp(NamedTuple):
    """The values kept from a step of warm-up: the position, the number of leapfrog steps, and the part that blackjax itself reads."""

    position: Array
    steps: Int[Array, ""]
    adaptation_state: _Centre


class NutsChains(NamedTuple):
    """The draws of chains and their figures, with a leading chain axis.

    Attributes:
        draws: the draws.
        divergent: whether each trajectory after warm-up diverged.
        steps: number of leapfrog steps of each trajectory.
        acceptance: acceptance rate of each trajectory.
        log_density: at each draw.
        step_size: step size after warm-up.
        warm_up_steps: number of leapfrog steps of the whole warm-up.
    """

    draws: Float[Array, "chain draw entry"]
    divergent: Bool[Array, "chain draw"]
    steps: Int[Array, "chain draw"]
    acceptance: Float[Array, "chain draw"]
    log_density: Float[Array, "chain draw"]
    step_size: Float[Array, " chain"]
    warm_up_steps: Int[Array, " chain"]


def run_nuts(
    key: Key, starts: Float[Array, "chain entry"], log_density: Callable[[Any, Array], Scalar], shared: Any, schedule: NutsSchedule
) -> NutsChains:
    """Run chains in parallel; each adapts by itself.

    Args:
        key: random key.
        starts: the starts.
        log_density: (shared, position) -> the log-density.
        shared: what the log-density needs: a pytree.
        schedule: the settings.
    """
    from blackjax.mcmc import nuts

    def sample_chain(item: tuple[Key, Array], shared: Any) -> tuple[Array, ...]:
        def target(position: Array) -> Scalar:
            return log_density(shared, position)

        (warm_key, draw_key), start = jax.random.split(item[0]), item[1]
        state, parameters, warm_up_steps = _warmed_up(warm_key, start, target, schedule)
        kernel = cast(Any, nuts.build_kernel)(divergence_threshold=DIVERGENCE)

        def step(state: Any, key: Key) -> tuple[Any, tuple[Array, ...]]:
            state, info = kernel(key, state, target, **parameters)
            return state, (state.position, info.is_divergent, info.num_integration_steps, info.acceptance_rate, state.logdensity)

        _, out = jax.lax.scan(step, state, jax.random.split(draw_key, schedule.draws))
        return (*out, jnp.asarray(parameters["step_size"]), warm_up_steps)

    chains = starts.shape[0]
    batch = -(-chains // len(jax.devices()))
    # JAX cannot check which values differ between devices in the loop of NUTS.
    return NutsChains(*over_particles(sample_chain, (jax.random.split(key, chains), starts), shared, batch, checked=False))


def _warmed_up(key: Key, start: Array, target: Callable[[Array], Scalar], schedule: NutsSchedule) -> tuple[Any, dict[str, Any], Int[Array, ""]]:
    """Return the state after warm-up, the kernel's parameters, and the number of leapfrog steps."""
    import blackjax

    low_rank = schedule.metric == "low_rank"
    options: dict[str, Any] = {"max_rank": RANK} if low_rank else {"is_mass_matrix_diagonal": schedule.metric == "diagonal"}
    adaptation = cast(Any, blackjax.window_adaptation_low_rank if low_rank else blackjax.window_adaptation)(
        blackjax.nuts,
        target,
        initial_step_size=0.5 * start.size**-0.25,
        target_acceptance_rate=schedule.target_acceptance,
        adaptation_info_fn=lambda state, info, adapted: _WarmUp(
            state.position, info.num_integration_steps, _Centre(getattr(adapted, "mu_star", None))
        ),
        max_num_doublings=DOUBLINGS,
        **options,
    )
    (state, parameters), warm_up = adaptation.run(key, start, schedule.warm_up)
    # After a low-rank warm-up blackjax puts every chain on the estimated mean, where chains could not disagree.
    state = cast(Any, blackjax.nuts.init)(warm_up.position[-1], target) if low_rank else state
    return state, parameters, jnp.sum(warm_up.steps)


@jax.jit
def chain_diagnostics(draws: Float[Array, "chain draw *shape"]) -> tuple[Float[Array, "*shape"], Float[Array, "*shape"]]:
    """Return the rank-normalised split R-hat and the bulk effective sample size (Vehtari et al. 2021) of each entry."""
    from blackjax.diagnostics import ess_bulk, rhat

    shape = draws.shape[2:]
    flat = draws.reshape(*draws.shape[:2], -1)
    r_hat, effective = (jnp.asarray(cast(Any, figure)(flat, chain_axis=0, sample_axis=1)).reshape(shape) for figure in (rhat, ess_bulk))
    return r_hat, effective
