r"""Limits of entries as Gaussian sites of expectation propagation (Minka 2001; Cunningham, Hennig & Lacoste-Julien 2011).

A site gives an entry the moments of its truncated marginal.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from bayes_body.density.coordinates import coordinates_after
from bayes_body.density.factor import State, Transition
from bayes_body.density.gaussian_view import joined

# Share of a new site in its update. Frames near a limit move together, and full updates overshoot: they go back and forth and never settle.
SITE_SHARE = 0.65
# Limits further away than this many standard deviations have no site.
NEAR = 5.0
# A limit further away than this many standard deviations has no effect on the inner side; on the outer, the tail beyond it is exponential: float32.
FARTHEST = 8.0
# The precision of a marginal without its own site is at least this share of its precision with it.
LEAST_CAVITY = 1e-2
# A coordinate at which a limited entry is at its limit, in any unit.
BEYOND = 1e6


class Sites(NamedTuple):
    """The Gaussian sites of the limits, about the path: `slope · d - precision · d² / 2` for an entry at a distance d from it."""

    slope: Float[Array, "frame entry"]
    precision: Float[Array, "frame entry"]

    def value(self, moved: Float[Array, "*draw frame entry"]) -> Float[Array, "*draw frame"]:
        """Return the sum over the entries at these distances from the path."""
        return jnp.sum(self.slope * moved - 0.5 * self.precision * moved**2, axis=-1)

    def recentred(self, moved: Float[Array, "frame entry"]) -> "Sites":
        """Return the same sites about a path at these distances."""
        return Sites(self.slope - self.precision * moved, self.precision)


def limits(transition: Transition, state: State) -> tuple[Float[Array, " entry"], Float[Array, " entry"]]:
    """Return the lower and the upper limits of the entries of a state, ∓∞ without one: where its unconstrained coordinates lead."""
    chart = coordinates_after(transition, state)
    low, high = (joined(chart.constrain({name: jnp.full_like(value, end) for name, value in state.items()})) for end in (-BEYOND, BEYOND))
    return jnp.where(low <= -BEYOND, -jnp.inf, low), jnp.where(high >= BEYOND, jnp.inf, high)


def updated(sites: Sites, move: Array, variances: Array, low: Array, high: Array) -> Sites:
    """Return the sites about the path after one update. All arguments are (frame, entry), and relative to the path.

    Args:
        sites: the sites.
        move: the mean of the Gaussian.
        variances: its marginal variances.
        low: the lower limits.
        high: the upper limits.
    """
    precision = jnp.maximum(1 / variances - sites.precision, LEAST_CAVITY / variances)
    mean = (move / variances - sites.slope) / precision
    shift, share = _truncated_moments((low - mean) * jnp.sqrt(precision), (high - mean) * jnp.sqrt(precision))
    matched = precision / share
    is_near = jnp.minimum(mean - low, high - mean) * jnp.sqrt(precision) < NEAR
    slope = jnp.where(is_near, matched * (mean + shift / jnp.sqrt(precision)) - precision * mean, 0.0)
    strength = jnp.where(is_near, jnp.maximum(matched - precision, 0.0), 0.0)
    return Sites(sites.slope + SITE_SHARE * (slope - sites.slope), sites.precision + SITE_SHARE * (strength - sites.precision))


def _truncated_moments(low: Array, high: Array) -> tuple[Array, Array]:
    """Return the mean and the variance of a standard normal number between two limits."""
    has_low, has_high, outside = low > -FARTHEST, high < FARTHEST, jnp.maximum(low, -high)
    tail = jnp.maximum(outside, 1.0)
    # A tail beyond z has about the mean z + 1 / z and the variance 1 / z².
    far_mean, far_variance = jnp.where(low > -high, 1.0, -1.0) * (tail + 1 / tail), 1 / tail**2
    low, high = jnp.clip(low, -FARTHEST, FARTHEST), jnp.clip(high, -FARTHEST, FARTHEST)
    cdf, pdf = jax.scipy.stats.norm.cdf, jax.scipy.stats.norm.pdf
    # In the upper tail the difference of the complements keeps its digits.
    mass = jnp.where(low > 0, cdf(-low) - cdf(-high), cdf(high) - cdf(low))
    mass = jnp.maximum(mass, jnp.finfo(mass.dtype).tiny)
    at_low, at_high = jnp.where(has_low, pdf(low), 0.0) / mass, jnp.where(has_high, pdf(high), 0.0) / mass
    mean = at_low - at_high
    # What rounding leaves of the difference is never less than the variance of an exponential tail nearly is.
    variance = jnp.maximum(1 + low * at_low - high * at_high - mean**2, 1 / (3 + jnp.maximum(outside, 0.0) ** 2))
    is_far = outside >= FARTHEST
    return jnp.where(is_far, far_mean, mean), jnp.where(is_far, far_variance, variance)
