r"""Messages and beliefs of particle belief propagation (Ihler & McAllester 2009).

A message is weighted particles behind a factor, never a kernel density:

$$m_{ij}(x) = \sum_n w^{(n)}_{ij}\, \psi_{ij}(x_i^{(n)}, x), \qquad
w^{(n)}_{ij} \propto \frac{\phi_i(x_i^{(n)}) \prod_{k \ne j} m_{ki}(x_i^{(n)})}{q_i(x_i^{(n)})},$$

with particles $x_i^{(n)}$ drawn from a proposal $q_i$ whose density is known exactly. Particles belong to nodes. Every message from a node weighs the
same particles, without the factor that came from its target (the cavity). A belief is $\phi_i \prod_k m_{ki}$ at the particles of its node.
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
from bayes_body.kernels.batching import ROWS, over_particles

type NodeValues = Float[Array, "node sample"]
type EdgeValues = Float[Array, "edge sample"]


class Directed(NamedTuple):
    """An array for each edge of one term and each direction: towards the second node of a row, and towards the first."""

    forward: Float[Array, "edge *values"]
    backward: Float[Array, "edge *values"]


class Beliefs(NamedTuple):
    """The particles of all nodes, and what is known of them.

    Attributes:
        points: particles of each node.
        log_q: log-density of the proposal that they were drawn from.
        likelihood: log of their tempered factors.
        rest: log of their other factors.
        messages: for each term of two nodes, log of the incoming messages at the particles of the target.
        ready: whether the node has particles yet.
    """

    points: Float[Array, "node sample *entry"]
    log_q: NodeValues
    likelihood: NodeValues
    rest: NodeValues
    messages: tuple[Directed, ...]
    ready: Float[Array, " node"]


def ends(term: Term) -> tuple[Int[Array, " edge"], Int[Array, " edge"]]:
    """Return the first and the second node of every row."""
    rows = jnp.asarray(term.rows)
    return rows[:, 0], rows[:, 1]


def slots(targets: Int[np.ndarray, " message"], count: int) -> Int[np.ndarray, "node slot"]:
    """Return the numbers of the messages into each of `count` nodes, given the targets of all; the number after the last is padding."""
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
    """Return the log-weight of every particle in its node's belief, not normalised. `power` is that of the likelihood."""
    total = beliefs.rest + power * beliefs.likelihood - beliefs.log_q
    for term, messages in zip(graph.pairs, beliefs.messages, strict=True):
        first, second = ends(term)
        total = total.at[second].add(messages.forward).at[first].add(messages.backward)
    return total


def cavities(graph: Graph, beliefs: Beliefs, power: float | Scalar = 1.0) -> tuple[Directed, ...]:
    """Return the normalised log-weights of the source's particles for every message: the belief without what came from the target."""
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
    """What the messages of one term come from.

    Attributes:
        points: for every message, particles of its source.
        weights: their normalised log-weights, the cavity.
        ready: for every message, whether its source has particles.
    """

    points: Directed
    weights: Directed
    ready: Directed


def sources(term: Term, cavity: Directed, points: Float[Array, "node sample *entry"], ready: Float[Array, " node"]) -> Sources:
    """Return what a term's messages come from, given the particles of all nodes."""
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
        come_from: the particles and weights that the messages come from.
        targets: particles of all nodes, at which they are evaluated.
        rows: the rows whose message goes to the second node, and those to the first.
        heard: the source is represented by so many of its particles, chosen by weight; None: by all, with their weights.
    """
    first, second = ends(term)
    last = len(term.plate.rows) - 1

    def message(row: Int[Array, ""], shared: tuple[Array, Array, Array, Array, Term], reverse: bool) -> Array:
        points, weights, ready, targets, term = shared
        parameters = jax.tree.map(lambda leaf: leaf[row], term.plate.parameters)
        some, log_weights = _represented(points[row], weights[row], heard)
        known = targets[(first if reverse else second)[row]]
        pairs = term.pairwise(parameters, known, some).T if reverse else term.pairwise(parameters, some, known)
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
    """Return the log of the tempered factors of one node, and of the others but the prior, at the particles of every node.

    Args:
        graph: the graph.
        points: particles of all nodes.
        rows: for each term, the rows that are evaluated; beyond the last one is padding. None: all.
    """
    nothing = jnp.zeros(points.shape[:2], points.dtype)
    likelihood, potential = nothing, nothing
    for number, term in enumerate(graph.unaries):
        nodes = jnp.asarray(term.rows[:, 0])
        some = jnp.arange(len(nodes)) if rows is None else rows[number]
        chosen = jnp.minimum(some, len(nodes) - 1)
        values = over_particles(_of_row, (chosen, points[nodes[chosen]]), term, ROWS)
        targets = jnp.where(some < len(nodes), nodes[chosen], graph.count)
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
