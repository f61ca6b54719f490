r"""The proposal of importance sampling: a mixture of the Gaussians at the modes, and a share of the prediction itself.

Draws come in pairs $\pm e$, and are stretched linearly so that their covariance is exactly I. Then the draws have exactly the moments of a Gaussian
posterior, whatever the random numbers. The tails are not made heavier: in tens of dimensions a Student's t loses more draws by its radius than it
gains.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from bayes_body.base.inverse_cdf import inverse_cdf
from bayes_body.base.shapes import Key, Scalar
from bayes_body.kernels.laplace.mode import Mode

# Two starts that end nearer to each other than this, in standard deviations of the posterior there, found one mode.
SAME = 1.0
# A mode competes if its mass is at most this factor of e below the mass of the largest.
COMPETES = 3.0
# Share of the prediction in a mixture of several modes.
DEFENSIVE = 0.05


class Proposal(NamedTuple):
    """A mixture of Gaussians in whitened coordinates; the last one is the prediction.

    Attributes:
        log_shares: log of the share of each; -∞ for one that is not used.
        centres: their means.
        roots: L with the precision L L^T of each.
        half_log_determinants: half of the log-determinant of the precision of each.
        modes: number of distinct modes that compete.
    """

    log_shares: Float[Array, " component"]
    centres: Float[Array, "component dof"]
    roots: Float[Array, "component dof dof"]
    half_log_determinants: Float[Array, " component"]
    modes: Scalar


def proposal_from(modes: Mode, is_used: Bool[Array, " start"]) -> Proposal:
    """Return the mixture of the modes, by Laplace's approximation of the mass of each.

    Args:
        modes: the modes of all starts, with a leading axis.
        is_used: which of them were searched. Of a single one, the proposal is its Gaussian alone.
    """
    roots = jnp.linalg.cholesky(modes.precision)
    half = jnp.sum(jnp.log(jax.vmap(jnp.diagonal)(roots)), axis=1)
    apart = jnp.einsum("kji,klj->kli", roots, modes.centre[None] - modes.centre[:, None])
    repeats = jnp.sum((jnp.sum(apart**2, axis=2) < SAME) & is_used, axis=1)
    masses = jnp.where(is_used, modes.height - half, -jnp.inf)
    competing = jnp.sum((masses > jnp.max(masses) - COMPETES) / jnp.maximum(repeats, 1))
    # Starts that found one mode share its mass.
    shares = jax.nn.log_softmax(masses - jnp.log(jnp.maximum(repeats, 1)))
    defensive = jnp.where(jnp.sum(is_used) > 1, DEFENSIVE, 0.0)
    dof, dtype = modes.centre.shape[1], modes.centre.dtype
    return Proposal(
        log_shares=jnp.append(shares + jnp.log1p(-defensive), jnp.log(defensive)),
        centres=jnp.concatenate([modes.centre, jnp.zeros((1, dof), dtype)]),
        roots=jnp.concatenate([roots, jnp.eye(dof, dtype=dtype)[None]]),
        half_log_determinants=jnp.append(half, 0.0),
        modes=competing,
    )


class Numbers(NamedTuple):
    """The random numbers of an attempt. They come from one call: each occurrence of a random generator adds to the compile time.

    Attributes:
        noise: balanced noise (`balanced`).
        starts: standard normal, without limits: where further searches start.
        order: standard normal, for a random order of the noise.
        level: uniform, which component the first draw comes from.
    """

    noise: Float[Array, "draw dof"]
    starts: Float[Array, "further dof"]
    order: Float[Array, " draw"]
    level: Scalar


def numbers(key: Key, count: int, size: int, further: int) -> Numbers:
    """Return the random numbers of an attempt with `count` draws of `size` entries, and `further` starts besides the mean of the prediction."""
    half = _half(count)
    sizes = np.cumsum([half * size, further * size, count])
    # Without the barrier, XLA repeats the draw wherever a part of it is read.
    normal = jax.lax.optimization_barrier(jax.random.normal(key, (sizes[-1] + 1,)))
    noise, starts, order, level = jnp.split(normal, sizes)
    return Numbers(balanced(noise.reshape(half, size), count), starts.reshape(further, size), order, jax.scipy.special.ndtr(level[0]))


def draw(numbers: Numbers, proposal: Proposal) -> tuple[Float[Array, "draw dof"], Float[Array, " draw"]]:
    """Return draws and their log-densities, without the constant of a standard normal."""
    noise, count = numbers.noise, len(numbers.noise)

    def from_first() -> tuple[Array, Array]:
        moved = jax.scipy.linalg.solve_triangular(proposal.roots[0], noise.T, lower=True, trans=1).T
        return proposal.centres[0] + moved, proposal.half_log_determinants[0] - 0.5 * jnp.sum(noise * noise, axis=1)

    def from_all() -> tuple[Array, Array]:
        levels = (jnp.arange(count) + numbers.level) / count
        chosen = inverse_cdf(jnp.cumsum(jnp.exp(proposal.log_shares)), levels)
        identity = jnp.eye(noise.shape[1], dtype=noise.dtype)
        inverses = jax.vmap(lambda root: jax.scipy.linalg.solve_triangular(root, identity, lower=True))(proposal.roots)
        # Otherwise the order of the noise, pair by pair, would go with the order of the components.
        shuffled = noise[jnp.argsort(numbers.order)]
        draws = proposal.centres[chosen] + jnp.einsum("nji,nj->ni", inverses[chosen], shuffled)
        return draws, log_density(proposal, draws)

    return jax.lax.cond(proposal.log_shares[0] >= 0, from_first, from_all)


def log_density(proposal: Proposal, draws: Float[Array, "draw dof"]) -> Float[Array, " draw"]:
    """Return the log-density of the mixture, without the constant of a standard normal."""
    whitened = jnp.einsum("kji,nkj->nki", proposal.roots, draws[:, None] - proposal.centres)
    terms = proposal.log_shares + proposal.half_log_determinants - 0.5 * jnp.sum(whitened**2, axis=2)
    return jax.nn.logsumexp(terms, axis=1)


def balanced_noise(key: Key, count: int, size: int) -> Float[Array, "draw {size}"]:
    """Return standard normal numbers as `balanced` does, from a random key."""
    return balanced(jax.random.normal(key, (_half(count), size)), count)


def balanced(normal: Float[Array, "half size"], count: int) -> Float[Array, "{count} size"]:
    """Return standard normal numbers whose mean is exactly 0 and whose covariance is exactly I, if there are enough draws for it.

    Draws come in pairs of opposite signs, made from half as many. An odd number of draws has no pairs; these are centred.
    """
    is_paired, size = count % 2 == 0, normal.shape[1]
    noise = normal
    if noise.shape[0] > size + 1:
        centred = noise if is_paired else noise - jnp.mean(noise, axis=0)
        root = jnp.linalg.cholesky(centred.T @ centred / centred.shape[0])
        noise = jax.scipy.linalg.solve_triangular(root, centred.T, lower=True).T
    return jnp.concatenate([noise, -noise]) if is_paired else noise


def _half(count: int) -> int:
    """Return the number of rows from which `balanced` makes `count` draws."""
    return count // 2 if count % 2 == 0 else count
