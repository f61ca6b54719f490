r"""How a filter answers on a boundary, steered to its normal (Nestares & Fleet 2001; Poon & Fleet 2002, (5) and (6)).

With the phase $\phi \in [0, \pi)$, the logarithm $\rho$ of the amplitude and $\rho' = (\rho - \rho_{min}) / (\rho_{max} - \rho_{min})$,

$$p(\phi \mid \rho) = \epsilon(\rho)\, \mathcal{N}(\phi; \pi/2, \sigma^2) + (1 - \epsilon(\rho)) / \pi, \qquad
\rho' \sim \mathrm{Beta}(a, b),$$

$\epsilon$ linear in $\rho'$. The phase is that of a step edge, whichever side is the brighter: folded modulo $\pi$. The normal law is wrapped around
that circle: normalised, and smooth where the phase wraps. $\rho'$ is clipped to $[\delta, 1 - \delta]$.
"""

import math
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax.scipy.special import betaln
from jaxtyping import Array, Float

# σ, radians.
PHASE_SD = 0.15 * math.pi
# δ: with a, b above 1 the density is zero at both ends.
NEAREST = 0.01
# Added to the square of an amplitude in grey levels, which would have no logarithm at zero.
FLOOR = 1e-6


class EdgeStatistics(NamedTuple):
    """The constants of one scale or, with a leading axis, of several.

    Attributes:
        epsilon: ε at ρ' = 0 and ρ' = 1.
        amplitude: a and b.
        log_amplitude: ρ_min and ρ_max, of grey levels.
        log_occluded: log p_occ, of a sample that is hidden.
    """

    epsilon: Float[Array | np.ndarray, "*scale 2"]
    amplitude: Float[Array | np.ndarray, "*scale 2"]
    log_amplitude: Float[Array | np.ndarray, "*scale 2"]
    log_occluded: Float[Array | np.ndarray, " *scale"]


def phase_and_log_amplitude(even: Array, odd: Array) -> tuple[Array, Array]:
    """φ − π/2, in [−π/2, π/2], and ρ."""
    sign = jnp.where(odd < 0, -1.0, 1.0)
    # Of a response of zero the phase is as good as any, and its gradient finite.
    nothing = (even == 0) & (odd == 0)
    phase = jnp.arctan2(jnp.where(nothing, 0.0, even * sign), jnp.where(nothing, 1.0, odd * sign))
    return phase, 0.5 * jnp.log(even * even + odd * odd + FLOOR)


def log_density(even: Array, odd: Array, statistics: EdgeStatistics) -> Array:
    """log p(φ | ρ) + log p(ρ) of responses; the statistics are broadcast against them (`epsilon[0]` is ε at ρ' = 0, and so on)."""
    phase, rho = phase_and_log_amplitude(even, odd)
    low, high = statistics.log_amplitude
    share = jnp.clip((rho - low) / (high - low), NEAREST, 1 - NEAREST)
    epsilon = statistics.epsilon[0] + (statistics.epsilon[1] - statistics.epsilon[0]) * share
    log_phase = jnp.log(epsilon * wrapped_normal(phase) + (1 - epsilon) / math.pi)
    a, b = statistics.amplitude
    return log_phase + (a - 1) * jnp.log(share) + (b - 1) * jnp.log1p(-share) - betaln(a, b) - jnp.log(high - low)


def wrapped_normal(phase: Array) -> Array:
    """The normal density of mean 0 and deviation `PHASE_SD` on a circle of length π."""
    images = sum(jnp.exp(-0.5 * ((phase + turn * math.pi) / PHASE_SD) ** 2) for turn in (-1, 0, 1))
    return jnp.asarray(images) / (PHASE_SD * math.sqrt(2 * math.pi))
