r"""Weights in the log domain. ESS $= 1 / \sum_i \pi_i^2$ for normalised $\pi$; survival rate = ESS / N (Deutscher & Reid 2005)."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from bayes_body.shapes import Flag, Scalar

type LogWeights = Float[Array, " particle"]


class Normalised(NamedTuple):
    """Log-weights that sum to one, the log of what they were divided by, and whether there was nothing to normalise."""

    log_weights: LogWeights
    log_sum: Scalar
    lost: Flag


def normalise(log_weights: LogWeights) -> Normalised:
    """NaN counts as weight zero; if no weight is left, all become equal and `lost` is set: the caller goes on from its prediction."""
    clean = jnp.where(jnp.isnan(log_weights), -jnp.inf, log_weights)
    # Differences first: a log-likelihood of some thousands, as of a whole image, leaves 32 bits no decimals for the sum's logarithm.
    peak = jnp.max(clean)
    relative = clean - jnp.where(jnp.isfinite(peak), peak, 0.0)
    log_ratio = jax.nn.logsumexp(relative)
    lost = ~jnp.isfinite(log_ratio)
    equal = jnp.full_like(clean, -jnp.log(clean.shape[0]))
    return Normalised(jnp.where(lost, equal, relative - jnp.where(lost, 0.0, log_ratio)), jnp.where(lost, log_ratio, peak + log_ratio), lost)


def effective_sample_size(log_weights: LogWeights) -> Scalar:
    """Of normalised or unnormalised log-weights, in particles."""
    weights = jnp.exp(log_weights - jnp.max(log_weights))
    return jnp.sum(weights) ** 2 / jnp.sum(weights * weights)
