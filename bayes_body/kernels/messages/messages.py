r"""Messages and beliefs of particle belief propagation (Ihler & McAllester 2009), and their diagnostics.

A message is a weighted sum of a factor at the particles of its source, not a kernel density:

$$m_{ij}(x) = \sum_n w^{(n)}_{ij}\, \psi_{ij}(x_i^{(n)}, x), \qquad
w^{(n)}_{ij} \propto \frac{\phi_i(x_i^{(n)}) \prod_{k \ne j} m_{ki}(x_i^{(n)})}{q_i(x_i^{(n)})},$$

with particles $x_i^{(n)}$ drawn from a proposal $q_i$ whose density is known exactly. Particles belong to nodes. All messages from a node use the
same particles. The weights of a message leave out the message from its target (the cavity). A belief is $\phi_i \prod_k m_{ki}$ at the particles of
its node.

The diagnostics show whether there are enough particles, and whether the iterations converged. Let $\mu_m$ be the mean and $\sigma_m$ the standard
deviations of a node's belief after iteration m of M, and $v(x, y)$ the tangent vector at x that leads to y, of D coordinates. Then

$$\text{change}_m = \sqrt{\tfrac1D \sum_d \frac{v_d(\mu_m, \mu_{m-1})^2}{\sigma_{m,d}^2}}, \qquad
\text{oscillation} = \sqrt{\max\Big(0, \tfrac1D \sum_d \frac{v_d(\mu_{M-1}, \mu_{M-2})\, v_d(\mu_{M-1}, \mu_M)}{\sigma_{M-1,d}^2}\Big)}.$$

The oscillation is 0 if the last two changes have the same direction, and equals them if the mean jumps back and forth. Particles alone change a mean
by about $\sqrt{2 / \text{ESS}}$. Loopy belief propagation can converge and still be wrong. These figures do not show that; the weights of the joint
draws do.
"""

import math
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from bayes_body.base.shapes import Scalar
from bayes_body.density.graph import Graph, Term
from bayes_body.density.spaces import Space
from bayes_body.kernels.batching import ROWS, over_particles

type NodeValues = Float[Array, "node sample"]
type EdgeValues = Float[Array, "edge sample"]


class Directed(NamedTuple):
    """An array for each edge of one term and each direction: towards the second node of a row, and towards the first."""

    forward: Float[Array, "edge *values"]
    backward: Float[Array, "edge *values"]


class Beliefs(NamedTuple):
    """The particles of all nodes, and the terms of their weights.

    Attributes:
        points: particles of each node.
        log_q: log-density of the proposal that they were drawn from.
        likelihood: log of their tempered factors.
        log_prior: log of their other factors.
        messages: for each term of two nodes, log of the incoming messages at the particles of the target.
        ready: whether the node has particles yet.
    """

    points: Float[Array, "node sample *entry"]
    log_q: NodeValues
    likelihood: NodeValues
    log_prior: NodeValues
    messages: tuple[Directed, ...]
    ready: Float[Array, " node"]


def ends(term: Term) -> tuple[Int[Array, " edge"], Int[Array, " edge"]]:
    """Return the first and the second node of every row."""
    rows = jnp.asarray(term.rows)
    return rows[:, 0], rows[:, 1]


def slots(targets: Int[np.ndarray, " message"], count: int) -> Int[np.ndarray, "node slot"]:
    """Return the numbers of the messages into each of `count` nodes, given the targets of all messages; the number after the last is padding."""
    into = [np.flatnonzero(targets == node) for node in range(count)]
    widest = max(map(len, into))
    return np.array([np.concatenate([numbers, np.full(widest - len(numbers), len(targets))]) for numbers in into], int).reshape(count, widest)


def normalised(log_weights: Float[Array, "*batch sample"]) -> Float[Array, "*batch sample"]:
    """Normalise log-weights over the last axis. NaN counts as zero; if all are zero, they become equal."""
    clean = jnp.where(jnp.isnan(log_weights), -jnp.inf, log_weights)
    peak = jnp.max(clean, axis=-1, keepdims=True)
    lost = ~jnp.isfinite(peak)
    relative = jnp.where(lost, 0.0, clean - jnp.where(lost, 0.0, peak))
    return relative - jax.nn.logsumexp(relative, axis=-1, keepdims=True)


def log_beliefs(graph: Graph, beliefs: Beliefs, power: float | Scalar = 1.0) -> NodeValues:
    """Return the log-weight of every particle in its node's belief, not normalised. `power` is the power of the likelihood."""
    total = beliefs.log_prior + power * beliefs.likelihood - beliefs.log_q
    for term, messages in zip(graph.pairs, beliefs.messages, strict=True):
        first, second = ends(term)
        total = total.at[second].add(messages.forward).at[first].add(messages.backward)
    return total


def cavities(graph: Graph, beliefs: Beliefs, power: float | Scalar = 1.0) -> tuple[Directed, ...]:
    """Return the normalised log-weights of the source's particles for every message: the belief without the message from the target."""
    total = log_beliefs(graph, beliefs, power)

    def cavity(term: Term, messages: Directed) -> Directed:
        first, second = ends(term)
        # A message of zero was counted in the total as minus infinity.
        return Directed(normalised(_without(total[first], messages.backward)), normalised(_without(total[second], messages.forward)))

    return tuple(cavity(term, messages) for term, messages in zip(graph.pairs, beliefs.messages, strict=True))


def _without(total: EdgeValues, message: EdgeValues) -> EdgeValues:
    finite = message > -jnp.inf
    return jnp.where(finite, total - jnp.where(finite, message, 0.0), -jnp.inf)


class Sources(NamedTuple):
    """The sources of the messages of one term.

    Attributes:
        points: for every message, particles of its source.
        weights: their normalised log-weights, the cavity.
        ready: for every message, whether its source has particles.
    """

    points: Directed
    weights: Directed
    ready: Directed


def sources(term: Term, cavity: Directed, points: Float[Array, "node sample *entry"], ready: Float[Array, " node"]) -> Sources:
    """Return the sources of a term's messages, given the particles of all nodes."""
    first, second = ends(term)
    return Sources(Directed(points[first], points[second]), cavity, Directed(ready[first], ready[second]))


def log_messages(
    term: Term,
    come_from: Sources,
    targets: Float[Array, "node target *entry"],
    rows: tuple[Int[Array, "_"], Int[Array, "_"]],
    heard: int | None = None,
) -> Directed:
    """Return the log of some of a term's messages at the particles of their targets; 0 from a node that has no particles yet.

    Args:
        term: the term.
        come_from: the sources of the messages.
        targets: particles of all nodes, at which the messages are evaluated.
        rows: the rows whose messages to the second node are evaluated, and those whose messages to the first are.
        heard: the number of particles, chosen by weight, that represent the source; None: all particles, with their weights.
    """
    first, second = ends(term)
    last = len(term.plate.rows) - 1

    def message(row: Int[Array, ""], shared: tuple[Array, Array, Array, Array, Term], reverse: bool) -> Array:
        points, weights, ready, targets, term = shared
        parameters = jax.tree.map(lambda leaf: leaf[row], term.plate.parameters)
        source_points, log_weights = _represented(points[row], weights[row], heard)
        target_points = targets[(first if reverse else second)[row]]
        pairs = term.pairwise(parameters, target_points, source_points).T if reverse else term.pairwise(parameters, source_points, target_points)
        return jnp.where(ready[row] > 0, jax.nn.logsumexp(without_nan(pairs) + log_weights[:, None], axis=0), 0.0)

    def evaluate(reverse: bool) -> Array:
        if not rows[reverse].size:
            return jnp.zeros((0, targets.shape[1]), targets.dtype)
        shared = (*(directed[reverse] for directed in come_from), targets, term)
        return over_particles(partial(message, reverse=reverse), jnp.minimum(rows[reverse], last), shared, ROWS)

    return Directed(evaluate(False), evaluate(True))


def _represented(
    points: Float[Array, "sample *entry"], log_weights: Float[Array, " sample"], count: int | None
) -> tuple[Float[Array, "some *entry"], Float[Array, " some"]]:
    """Return `count` of the points with equal weights, at the middles of equal shares of the weight; or all of them with their weights."""
    if count is None or count >= points.shape[0]:
        return points, log_weights
    cumulative = jnp.cumsum(jnp.exp(log_weights))
    chosen = jnp.searchsorted(cumulative, (jnp.arange(count) + 0.5) / count * cumulative[-1])
    return points[jnp.minimum(chosen, points.shape[0] - 1)], jnp.full(count, -math.log(count), log_weights.dtype)


def without_nan(pairs: Array) -> Array:
    """Return log-potentials with zero potential in place of NaN."""
    return jnp.where(jnp.isnan(pairs), -jnp.inf, pairs)


def entered(old: Directed, new: Directed, rows: tuple[Array, Array]) -> Directed:
    """Return the messages with those of some rows replaced. Rows beyond the last one are padding."""
    return Directed(old.forward.at[rows[0]].set(new.forward, mode="drop"), old.backward.at[rows[1]].set(new.backward, mode="drop"))


def unary_values(
    graph: Graph, points: Float[Array, "node sample *entry"], rows: tuple[Int[Array, "_"], ...] | None = None
) -> tuple[NodeValues, NodeValues]:
    """Return the log of the tempered factors of one node, and of the others except the prior, at the particles of every node.

    Args:
        graph: the graph.
        points: particles of all nodes.
        rows: for each term, the rows that are evaluated; numbers beyond the last row are padding. None: all.
    """
    zeros = jnp.zeros(points.shape[:2], points.dtype)
    likelihood, potential = zeros, zeros
    for number, term in enumerate(graph.unaries):
        nodes = jnp.asarray(term.rows[:, 0])
        row_numbers = jnp.arange(len(nodes)) if rows is None else rows[number]
        chosen = jnp.minimum(row_numbers, len(nodes) - 1)
        values = over_particles(_of_row, (chosen, points[nodes[chosen]]), term, ROWS)
        targets = jnp.where(row_numbers < len(nodes), nodes[chosen], graph.count)
        if term.tempered:
            likelihood = likelihood.at[targets].add(values, mode="drop")
        else:
            potential = potential.at[targets].add(values, mode="drop")
    return likelihood, potential


def _of_row(row: tuple[Int[Array, ""], Float[Array, "sample *entry"]], term: Term) -> Float[Array, " sample"]:
    """Return the log of a factor of one node at all particles of its node."""
    number, points = row
    parameters = jax.tree.map(lambda leaf: leaf[number], term.plate.parameters)
    return jax.vmap(lambda x: term.log_potential(parameters, x))(points)


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
        space: the space of a node's value.
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
    undefined = jnp.full_like(sds[:1, :, 0], jnp.nan)
    return jnp.concatenate([undefined, jnp.sqrt(jnp.mean(vectors**2, axis=-1))])


def oscillation(space: Space, means: Float[Array, "iteration node *entry"], sds: Float[Array, "iteration node dimension"]) -> Float[Array, " node"]:
    """Return how far the mean of every belief jumped back in the last iteration, in standard deviations; NaN with fewer than three iterations."""
    if means.shape[0] < 3:
        return jnp.full_like(sds[0, :, 0], jnp.nan)
    back, forward = (jnp.asarray(space.local(means[-2], means[iteration])) / (sds[-2] + TINY) for iteration in (-3, -1))
    return jnp.sqrt(jnp.maximum(jnp.mean(back * forward, axis=-1), 0.0))


def shares_of_weight(log_weights: Float[Array, "node sample"], log_parts: Float[Array, "node sample part"]) -> Float[Array, "node 4"]:
    r"""Return $\sum_n w_n\, \gamma_k q_k(x_n) / q(x_n)$ for each part k of every node's proposal: the share of the weight that it contributed.

    The first part is that of the messages, the second the prior, the last the normal fit. Those in between are detections; their shares are added.

    Args:
        log_weights: normalised log-weights of the points of the joint draws.
        log_parts: $\log \gamma_k q_k$ at these points.
    """
    shares = jnp.einsum("ns,nsk->nk", jnp.exp(log_weights), jax.nn.softmax(log_parts, axis=-1))
    return jnp.stack([shares[:, 0], shares[:, 1], jnp.sum(shares[:, 2:-1], axis=1), shares[:, -1]], axis=1)
