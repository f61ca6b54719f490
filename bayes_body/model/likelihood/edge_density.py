r"""The density of a filter's response on a boundary, steered to its normal (Nestares & Fleet 2001; Poon & Fleet 2002, (5) and (6)).

With the phase $\phi \in [0, \pi)$, the logarithm $\rho$ of the amplitude and $\rho' = (\rho - \rho_{min}) / (\rho_{max} - \rho_{min})$,

$$p(\phi \mid \rho) = \epsilon(\rho)\, \mathcal{N}(\phi; \pi/2, \sigma^2) + (1 - \epsilon(\rho)) / \pi, \qquad
p(\rho') \propto c(\rho')^{a-1} (1 - c(\rho'))^{b-1},$$

$\epsilon$ is linear in $\rho'$. The phase is that of a step edge with either side brighter, so it is folded modulo $\pi$. The normal distribution is
wrapped around that circle, so it is normalised, and smooth where the phase wraps. The paper's distribution of $\rho'$ is Beta(a, b). Here $c$ clips
it to $[\delta, 1 - \delta]$, softly: with a hard clip the density would have slopes of $(a - 1) / \delta$, which would force short steps on
Hamiltonian Monte Carlo. It is normalised over $[\rho_{min}, \rho_{max}]$. For a response outside, which the paper leaves open, the value at the
nearer end counts.
"""

import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

# σ, radians.
PHASE_SD = 0.15 * math.pi
# δ: with a, b above 1, a Beta density would be zero at both ends.
NEAREST = 0.01
# The fraction of the range of ρ' over which the soft clip bends.
BEND = 0.05
# Nodes of the integral over ρ'.
QUADRATURE = 64
# Added to the square of an amplitude in grey levels, because zero has no logarithm.
FLOOR = 1e-6


class EdgeStatistics(NamedTuple):
    """The constants of one scale or, with a leading axis, of several.

    Attributes:
        epsilon: ε at ρ' = 0 and at ρ' = 1.
        amplitude: a and b.
        log_amplitude: ρ_min and ρ_max; amplitudes in grey levels.
        log_occluded: log p_occ, for a hidden sample.
    """

    epsilon: Float[Array | np.ndarray, "*scale 2"]
    amplitude: Float[Array | np.ndarray, "*scale 2"]
    log_amplitude: Float[Array | np.ndarray, "*scale 2"]
    log_occluded: Float[Array | np.ndarray, " *scale"]


def phase_and_log_amplitude(even: Array, odd: Array) -> tuple[Array, Array]:
    """φ − π/2, in [−π/2, π/2], and ρ."""
    sign = jnp.where(odd < 0, -1.0, 1.0)
    # For a response of zero any phase will do, as long as its gradient is finite.
    nothing = (even == 0) & (odd == 0)
    phase = jnp.arctan2(jnp.where(nothing, 0.0, even * sign), jnp.where(nothing, 1.0, odd * sign))
    return phase, 0.5 * jnp.log(even * even + odd * odd + FLOOR)


def log_density(even: Array, odd: Array, statistics: EdgeStatistics) -> Array:
    """log p(φ | ρ) + log p(ρ) of responses; the statistics are broadcast against them (`epsilon[0]` is ε at ρ' = 0, and so on)."""
    phase, rho = phase_and_log_amplitude(even, odd)
    share = share_of(rho, statistics)
    epsilon = statistics.epsilon[0] + (statistics.epsilon[1] - statistics.epsilon[0]) * share
    return jnp.log(epsilon * wrapped_normal(phase) + (1 - epsilon) / math.pi) + amplitude_log_density(share, statistics)


def amplitude_log_density(share: Array, statistics: EdgeStatistics) -> Array:
    """log p(ρ), for clipped shares ρ'."""
    (low, high), (a, b) = statistics.log_amplitude, jnp.asarray(statistics.amplitude)
    return (a - 1) * jnp.log(share) + (b - 1) * jnp.log1p(-share) - log_normaliser(a, b) - jnp.log(high - low)


def share_of(rho: Array, statistics: EdgeStatistics) -> Array:
    """ρ', clipped."""
    low, high = statistics.log_amplitude
    return clipped((rho - low) / (high - low))


def clipped(share: Array) -> Array:
    """ρ' clipped to [δ, 1 − δ]: nearly ρ' itself well inside, and smooth everywhere."""
    above, below = (0.5 * (x + jnp.sqrt(x * x + (2 * BEND) ** 2)) for x in (share, 1 - share))
    return NEAREST + (1 - 2 * NEAREST) * above / (above + below)


def log_normaliser(a: Array, b: Array) -> Array:
    """log of the integral of c^(a-1) (1-c)^(b-1) over ρ' in [0, 1]; without the clip it is log B(a, b)."""
    middles = clipped((jnp.arange(QUADRATURE, dtype=jnp.result_type(float)) + 0.5) / QUADRATURE)
    logs = (a[..., None] - 1) * jnp.log(middles) + (b[..., None] - 1) * jnp.log1p(-middles)
    return jax.nn.logsumexp(logs, axis=-1) - math.log(QUADRATURE)


def wrapped_normal(phase: Array) -> Array:
    """The normal density with mean 0 and standard deviation `PHASE_SD`, wrapped on a circle of length π."""
    images = sum(jnp.exp(-0.5 * ((phase + turn * math.pi) / PHASE_SD) ** 2) for turn in (-1, 0, 1))
    return jnp.asarray(images) / (PHASE_SD * math.sqrt(2 * math.pi))
