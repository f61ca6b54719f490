r"""Proposals of particle belief propagation: one normalised mixture for each node.

$$q_i = \gamma_1 \frac{1}{d_i} \sum_{k \to i} m_{ki} + \gamma_2\, \pi_i + \gamma_3\, f_i + \gamma_4\, b_i$$

with the incoming messages $m_{ki}$ from which one can draw, the prior $\pi_i$ of the node, its detections $f_i$, and a distribution $b_i$ near its
last belief. The method gives $b_i$ (kernels/messages/methods.py); by default it is a normal distribution fitted to the belief. Every part is
normalised, so q is an exact density (the balance heuristic of Veach & Guibas 1995), and weights need no unknown constants. The share of a missing
part goes to the others, but detections keep theirs.

The share of detections adapts. With the particles of the last round and their weights $w^{(n)}$ in the belief, the share of mixture k of detections
is the part of the weight that it brought,

$$\gamma_{ik} = \sum_n w^{(n)}\, \frac{\gamma'_{ik} f_{ik}(x^{(n)})}{q'_i(x^{(n)})},$$

with the last proposal $q'$ and share $\gamma'$ (Douc, Guillin, Marin & Robert 2007). It is never below LEAST of the first share, so that a detection
that was not needed yet is not lost, and all of them together never exceed MOST. A round's shares follow from the particles before it, so its weights
are exact.
"""

import math
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from bayes_body.base.inverse_cdf import inverse_cdf
from bayes_body.base.shapes import Key
from bayes_body.density.graph import Graph, Term
from bayes_body.kernels.messages.messages import Beliefs, Directed, NodeValues, ends

# Bounds of the share of detections: as a part of their first share, and of the whole.
LEAST, MOST = 0.2, 0.8
# The default floors of a fit: standard deviations below which tracking would lose a limb that moves.
FLOORS = {"m": 0.01, "rad": math.radians(1.0)}


class Shares(NamedTuple):
    """Shares of a node's proposal, which need not sum to one."""

    messages: float
    prior: float
    detections: float
    fit: float


class Proposals(NamedTuple):
    """The proposal of every node.

    Attributes:
        points: the particles of the messages' sources.
        cavities: their weights.
        belief_proposals: a distribution near each belief, stacked over the nodes.
        shares: log-shares of messages, prior, each mixture of detections, and the distribution near the belief.
        edges: for each term, the log-probability of each message among the messages to its target.
    """

    points: Float[Array, "node sample *entry"]
    cavities: tuple[Directed, ...]
    belief_proposals: Any
    shares: Float[Array, "node part"]
    edges: tuple[Directed, ...]


def proposals(
    graph: Graph,
    beliefs: Beliefs,
    cavities: tuple[Directed, ...],
    belief_proposals: Any,
    shares: Shares,
    is_sole_proposal: bool,
    detections: Float[Array, "node mixture"] | None = None,
) -> Proposals:
    """Return the proposal of every node.

    Args:
        graph: the graph.
        beliefs: particles and messages.
        cavities: normalised log-weights for each message.
        belief_proposals: a distribution near each belief, stacked over the nodes.
        shares: the shares of a node that has all parts.
        is_sole_proposal: whether `belief_proposals` are the whole proposal of a node that has particles.
        detections: for each node, the share of each mixture of detections in the whole; by default the first shares.
    """
    degree = jnp.zeros(graph.count, beliefs.points.dtype)
    for term in graph.pairs:
        if term.plate.draw is not None:
            first, second = ends(term)
            degree = degree.at[second].add(beliefs.ready[first]).at[first].add(beliefs.ready[second])

    def probability(term: Term) -> Directed:
        first, second = ends(term)
        able = 1.0 if term.plate.draw is not None else 0.0
        return Directed(
            jnp.log(able * beliefs.ready[first] / jnp.maximum(degree[second], 1)),
            jnp.log(able * beliefs.ready[second] / jnp.maximum(degree[first], 1)),
        )

    no_share = jnp.zeros(graph.count, beliefs.points.dtype)
    mixtures = [no_share if graph.prior is None else graph.prior.exists, *(mixture.exists for mixture in graph.proposals)]
    remainder = 1 - beliefs.ready if is_sole_proposal else jnp.ones_like(no_share)
    other_shares = [
        remainder * shares.messages * (degree > 0),
        remainder * shares.prior * mixtures[0],
        (1.0 if is_sole_proposal else shares.fit) * beliefs.ready,
    ]
    detected = first_shares(graph, shares) if detections is None else detections
    detected = [remainder * share * exists for share, exists in zip(detected.T, mixtures[1:], strict=True)]
    remaining = (1 - sum(detected, no_share)) / jnp.maximum(sum(other_shares, no_share), 1e-30)
    of_messages, of_prior, of_fit = (remaining * share for share in other_shares)
    table = jnp.stack([jnp.asarray(part, no_share.dtype) for part in (of_messages, of_prior, *detected, of_fit)], axis=1)
    # If no part that a node has gets a share, its first particles come from prior and detections.
    begin = jnp.stack([no_share, *(jnp.asarray(exists, no_share.dtype) for exists in mixtures), no_share], axis=1)
    table = jnp.where(jnp.sum(table, axis=1, keepdims=True) > 0, table, begin)
    return Proposals(
        beliefs.points,
        cavities,
        belief_proposals,
        jnp.log(table / jnp.maximum(jnp.sum(table, axis=1, keepdims=True), 1e-30)),
        tuple(map(probability, graph.pairs)),
    )


def first_shares(graph: Graph, shares: Shares) -> Float[Array, "node mixture"]:
    """Return the share of each mixture of detections in the whole proposal of a node, before anything is known of them."""
    count = len(graph.proposals)
    return jnp.full((graph.count, count), shares.detections / max(sum(shares), 1e-30) / max(count, 1))


def adapted_shares(first: Float[Array, "node mixture"], brought: Float[Array, "node mixture"]) -> Float[Array, "node mixture"]:
    """Return the next shares of the mixtures of detections, given the part of the belief's weight that they brought."""
    wanted = jnp.maximum(brought, LEAST * first)
    return wanted * jnp.minimum(1.0, MOST / jnp.maximum(jnp.sum(wanted, axis=1, keepdims=True), 1e-30))


def draw(key: Key, graph: Graph, proposal: Proposals, count: int) -> Float[Array, "node draw *entry"]:
    """Draw `count` values of every node; each part of the mixture has its share of them, up to random rounding."""
    part_key, message_key, near_key, *keys = jax.random.split(key, 3 + 1 + len(graph.proposals))
    levels = (jnp.arange(count) + jax.random.uniform(part_key, (graph.count, 1))) / count
    part = jnp.sum(levels[..., None] > jnp.cumsum(jnp.exp(proposal.shares), axis=1)[:, None, :-1], axis=-1)
    draws = [_from_messages(message_key, graph, proposal, count)]
    draws += [draws[0] if graph.prior is None else graph.prior.sample(keys[0], count)]
    draws += [mixture.sample(mixture_key, count) for mixture_key, mixture in zip(keys[1:], graph.proposals, strict=True)]
    near_keys = jax.random.split(near_key, (graph.count, count))
    draws += [jax.vmap(lambda distribution, node_keys: jax.vmap(distribution.sample)(node_keys))(proposal.belief_proposals, near_keys)]
    shape = (graph.count, count, *[1] * (proposal.points.ndim - 2))
    values = draws[0]
    for number, drawn in enumerate(draws[1:], 1):
        values = jnp.where((part == number).reshape(shape), drawn, values)
    return values


def _from_messages(key: Key, graph: Graph, proposal: Proposals, count: int) -> Float[Array, "node draw *entry"]:
    """Draw values of every node from the mixture of the messages into it. A node without messages gets copies of its particles, without a share."""
    pick_key, draw_key = jax.random.split(key)
    samples = proposal.points.shape[1]
    sources, targets, log_weights, parts = [], [], [], []
    for term, cavity, edge in zip(graph.pairs, proposal.cavities, proposal.edges, strict=True):
        if term.plate.draw is None:
            continue
        first, second = ends(term)
        for reverse, nodes in ((False, (first, second)), (True, (second, first))):
            parts.append((term, reverse, sum(map(len, sources))))
            sources.append(nodes[0])
            targets.append(nodes[1])
            log_weights.append(cavity[reverse] + edge[reverse][:, None])
    if not parts:
        return jnp.take(proposal.points, jnp.arange(count) % samples, axis=1)
    source, target = jnp.concatenate(sources), jnp.concatenate(targets)
    weights = jnp.exp(jnp.concatenate(log_weights))

    def pick(key: Key, node: Array) -> tuple[Array, Array]:
        within, order = jax.random.split(key)
        cumulative = jnp.cumsum((weights * (target == node)[:, None]).ravel())
        levels = (jnp.arange(count) + jax.random.uniform(within, (count,))) / count
        index = inverse_cdf(cumulative, jax.random.permutation(order, levels))
        return index // samples, index % samples

    edge, particle = jax.vmap(pick)(jax.random.split(pick_key, graph.count), jnp.arange(graph.count))
    source_points = proposal.points[source[edge], particle]
    values = jnp.take(proposal.points, jnp.arange(count) % samples, axis=1)
    for (term, reverse, start), term_key in zip(parts, jax.random.split(draw_key, len(parts)), strict=True):
        rows = len(term.plate.rows)
        row = jnp.clip(edge - start, 0, rows - 1)

        def draw_along(key: Key, row: Array, source_point: Array, term: Term = term, reverse: bool = reverse) -> Array:
            assert term.plate.draw is not None
            return term.plate.draw(key, jax.tree.map(lambda leaf: leaf[row], term.plate.parameters), source_point, reverse)

        drawn = jax.vmap(jax.vmap(draw_along))(jax.random.split(term_key, (graph.count, count)), row, source_points)
        mine = ((edge >= start) & (edge < start + rows)).reshape(edge.shape + (1,) * (values.ndim - 2))
        values = jnp.where(mine, drawn, values)
    return values


def log_density(
    graph: Graph, proposal: Proposals, points: Float[Array, "node draw *entry"], messages: tuple[Directed, ...], prior: NodeValues
) -> NodeValues:
    """Return the log-density of the proposal of every node.

    Args:
        graph: the graph.
        proposal: the proposals.
        points: where it is evaluated.
        messages: log of all messages at these points.
        prior: log of the prior at these points; anything if the graph has none, since it then has no share.
    """
    return jax.nn.logsumexp(log_parts(graph, proposal, points, messages, prior), axis=-1)


def log_parts(
    graph: Graph, proposal: Proposals, points: Float[Array, "node draw *entry"], messages: tuple[Directed, ...], prior: NodeValues
) -> Float[Array, "node draw part"]:
    """Return the terms of `log_density`: log of share times density, for messages, prior, each mixture of detections, and `belief_proposals`."""
    log_zero = jnp.full(points.shape[:2], -jnp.inf, points.dtype)
    mixed = log_zero
    for number, (term, edge) in enumerate(zip(graph.pairs, proposal.edges, strict=True)):
        if term.plate.draw is None:
            continue
        first, second = ends(term)
        values = messages[number] if term.plate.log_draw is None else _drawn_density(term, proposal, number, points)
        values = values if term.plate.log_beside is None else _with_beside(term, values, points)
        for node, value, log_share in ((second, values.forward, edge.forward), (first, values.backward, edge.backward)):
            mixed = _log_added(mixed, node, value + log_share[:, None])
    mixtures = [prior, *(mixture.log_prob(points) for mixture in graph.proposals)]
    close = jax.vmap(lambda distribution, xs: jax.vmap(distribution.log_prob)(xs))(proposal.belief_proposals, points)
    return jnp.stack([mixed, *mixtures, close], axis=-1) + proposal.shares[:, None]


def _drawn_density(term: Term, proposal: Proposals, number: int, points: Array) -> Directed:
    """Return the densities of the draws along each edge, for a factor that is not itself their density."""
    first, second = ends(term)
    log_draw = term.plate.log_draw
    assert log_draw is not None

    def mixture(parameters: Any, source_points: Array, weights: Array, values: Array, reverse: bool) -> Array:
        log_pairs = jax.vmap(lambda y: jax.vmap(lambda x: log_draw(parameters, x, y, reverse))(source_points))(values)
        return jax.nn.logsumexp(log_pairs + weights[None], axis=1)

    forward = jax.vmap(lambda p, x, w, y: mixture(p, x, w, y, False))
    backward = jax.vmap(lambda p, x, w, y: mixture(p, x, w, y, True))
    return Directed(
        forward(term.plate.parameters, proposal.points[first], proposal.cavities[number].forward, points[second]),
        backward(term.plate.parameters, proposal.points[second], proposal.cavities[number].backward, points[first]),
    )


def _with_beside(term: Term, values: Directed, points: Array) -> Directed:
    """Return the densities of the draws along each edge, given the values of the factors, for draws that have coordinates beside those."""
    first, second = ends(term)
    log_beside = term.plate.log_beside
    assert log_beside is not None

    def beside(nodes: Array, reverse: bool) -> Array:
        return jax.vmap(lambda parameters, xs: jax.vmap(lambda x: log_beside(parameters, x, reverse))(xs))(term.plate.parameters, points[nodes])

    return Directed(values.forward + beside(second, False), values.backward + beside(first, True))


def _log_added(total: NodeValues, nodes: Array, values: Array) -> NodeValues:
    """Return the logarithm of the totals plus the sum of the values by node."""
    peak = total.at[nodes].max(values)
    safe = jnp.where(jnp.isfinite(peak), peak, 0.0)
    return safe + jnp.log(jnp.exp(total - safe).at[nodes].add(jnp.exp(values - safe[nodes])))
