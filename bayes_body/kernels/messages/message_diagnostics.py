r"""Diagnostics of particle belief propagation: whether the particles are enough, and whether the iterations converged.

With the mean $\mu_m$ and the standard deviations $\sigma_m$ of a node's belief after iteration m of M, and the tangent vector $v(x, y)$ at x that
leads to y, of D coordinates,

$$\text{change}_m = \sqrt{\tfrac1D \sum_d \frac{v_d(\mu_m, \mu_{m-1})^2}{\sigma_{m,d}^2}}, \qquad
\text{oscillation} = \sqrt{\max\Big(0, \tfrac1D \sum_d \frac{v_d(\mu_{M-1}, \mu_{M-2})\, v_d(\mu_{M-1}, \mu_M)}{\sigma_{M-1,d}^2}\Big)}.$$

The oscillation is 0 if the last two changes have the same direction, and equals them if the mean jumps back and forth. Particles alone change a mean
by about $\sqrt{2 / \text{ESS}}$. Loopy belief propagation can converge and still be wrong: these figures do not show that, the weights of the joint
draws do.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from bayes_body.base.shapes import Scalar
from bayes_body.density.spaces import Space

# Added to every standard deviation: all weight may be on one particle.
TINY = 1e-6


class Summary(NamedTuple):
    """Figures of the beliefs after a round; with a leading axis of rounds in `Passed`.

    Attributes:
        means: mean of every node's belief, a point.
        sds: standard deviations of the tangent vectors around it.
        belief_ess: effective sample size of every belief.
        message_ess: the smallest effective sample size of the weights of a message's source.
    """

    means: Float[Array, "node *entry"]
    sds: Float[Array, "node dimension"]
    belief_ess: Float[Array, " node"]
    message_ess: Scalar


def belief_sds(
    space: Space, weights: Float[Array, "node sample"], points: Float[Array, "node sample *entry"], means: Float[Array, "node *entry"]
) -> Float[Array, "node dimension"]:
    """Return the standard deviations of every belief, in tangent coordinates at its mean; `weights` are normalised."""
    vectors = jnp.asarray(space.local(means[:, None], points))
    return jnp.sqrt(jnp.sum(weights[..., None] * vectors**2, axis=1))


def message_figures(
    space: Space, rounds: Summary, iterations: int, samples: int, joint_ess: Scalar, proposal_shares: Float[Array, "node 4"]
) -> dict[str, Array]:
    """Return the figures that a kernel puts into `FilterInfo.messages`.

    Args:
        space: where the value of a node lives.
        rounds: figures after every round.
        iterations: number of iterations, each of equally many rounds.
        samples: number of particles of a node.
        joint_ess: effective sample size of the joint draws.
        proposal_shares: for each node, the share of each part of the proposal in the weight of its particles.
    """
    stride = rounds.means.shape[0] // iterations
    means, sds = rounds.means[stride - 1 :: stride], rounds.sds[stride - 1 :: stride]
    return {
        "samples": jnp.asarray(samples, jnp.int32),
        "belief_ess": rounds.belief_ess[-1],
        "message_ess": rounds.message_ess[-1],
        "message_change": changes(space, means, sds),
        "belief_sd": sds,
        "oscillation": oscillation(space, means, sds),
        "joint_ess": joint_ess,
        "proposal_shares": proposal_shares,
    }


def changes(
    space: Space, means: Float[Array, "iteration node *entry"], sds: Float[Array, "iteration node dimension"]
) -> Float[Array, "iteration node"]:
    """Return how far the mean of every belief moved in each iteration, in standard deviations of the belief after it; NaN in the first."""
    vectors = jnp.asarray(space.local(means[1:], means[:-1])) / (sds[1:] + TINY)
    unknown = jnp.full_like(sds[:1, :, 0], jnp.nan)
    return jnp.concatenate([unknown, jnp.sqrt(jnp.mean(vectors**2, axis=-1))])


def oscillation(space: Space, means: Float[Array, "iteration node *entry"], sds: Float[Array, "iteration node dimension"]) -> Float[Array, " node"]:
    """Return how far the mean of every belief jumped back in the last iteration, in standard deviations; NaN with fewer than three iterations."""
    if means.shape[0] < 3:
        return jnp.full_like(sds[0, :, 0], jnp.nan)
    back, forward = (jnp.asarray(space.local(means[-2], means[iteration])) / (sds[-2] + TINY) for iteration in (-3, -1))
    return jnp.sqrt(jnp.maximum(jnp.mean(back * forward, axis=-1), 0.0))


def shares_of_weight(log_weights: Float[Array, "node sample"], log_parts: Float[Array, "node sample part"]) -> Float[Array, "node 4"]:
    r"""Return $\sum_n w_n\, \gamma_k q_k(x_n) / q(x_n)$ for each part k of every node's proposal: the share of the weight that it brought.

    The first part is that from messages, the second the prior, the last the normal fit; those between are detections and are added up.

    Args:
        log_weights: normalised log-weights of the points of the joint draws.
        log_parts: $\log \gamma_k q_k$ at these points.
    """
    shares = jnp.einsum("ns,nsk->nk", jnp.exp(log_weights), jax.nn.softmax(log_parts, axis=-1))
    return jnp.stack([shares[:, 0], shares[:, 1], jnp.sum(shares[:, 2:-1], axis=1), shares[:, -1]], axis=1)
