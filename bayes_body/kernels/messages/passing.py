r"""A round of particle belief propagation: nodes are redrawn from their proposals, and the messages into them are evaluated.

Messages may be damped. The particles at which the last message was evaluated are gone, so each message keeps the particles and weights of its source
from its last update. At the new particles, the new and the last message are evaluated and mixed,

$$\log m_{ij}(x) = (1 - d) \log \hat m_{ij}(x) + d \log \hat m'_{ij}(x),$$

with the message $\hat m_{ij}$ from the current particles of the source and $\hat m'_{ij}$ from the kept ones. A message on which both agree stays as
it is, so the fixed points are those without damping. An error that changes its sign from round to round is averaged away.
"""

import math
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from bayes_body.base.shapes import Key, Scalar
from bayes_body.density.graph import Graph, Term
from bayes_body.density.tangent_normal import fit
from bayes_body.kernels.messages.joint_particles import Redrawn
from bayes_body.kernels.messages.messages import (
    Beliefs,
    Directed,
    NodeValues,
    Sources,
    Summary,
    belief_sds,
    cavities,
    entered,
    log_beliefs,
    log_messages,
    normalised,
    sources,
    unary_values,
)
from bayes_body.kernels.messages.methods import MethodName, method
from bayes_body.kernels.messages.node_proposals import (
    FLOORS,
    Proposals,
    Shares,
    adapted_shares,
    draw,
    first_shares,
    log_density,
    log_parts,
    proposals,
)
from bayes_body.kernels.messages.schedules import Round, depths
from bayes_body.kernels.weights import effective_sample_size


class Memory(NamedTuple):
    """The values that are kept from round to round, besides the beliefs.

    Attributes:
        method: what the method remembers.
        last: for each term, the sources of its messages at their last update; empty without damping.
        detected: at the particles of each node, the share of each mixture of detections in the proposal that they were drawn from; None if shares
            do not adapt.
    """

    method: Any
    last: tuple[Sources, ...]
    detected: Float[Array, "node sample mixture"] | None = None


class Settings(NamedTuple):
    """The settings of message passing.

    Attributes:
        samples: number of particles of a node.
        heard: number of particles that represent a node in messages of factors that only close loops.
        shares: the shares of a node's proposal.
        inflation: factor of the covariance of normal distributions in a proposal.
        method: the method.
        damping: d, from 0 to below 1.
    """

    samples: int
    heard: int
    shares: Shares
    inflation: float
    method: MethodName
    damping: float


class Passing:
    """The computations of a round on one graph."""

    def __init__(self, graph: Graph, settings: Settings):
        """Take the graph and the settings."""
        self.graph, self.settings = graph, settings
        self.floors = jnp.array([FLOORS.get(unit, 0.0) for unit in graph.space.tangent_units])
        self.method = method(settings.method, settings.inflation, self.floors)
        # The number of particles of each node.
        self.held = settings.samples
        # A method that draws from its own distribution alone has no share to adapt.
        self.adapts = bool(graph.proposals) and settings.shares.detections > 0 and not self.method.is_sole_proposal

    def begin(self, key: Key) -> tuple[Beliefs, Memory]:
        """Return beliefs whose nodes are not ready. Messages from them say nothing yet; their first round draws them from prior and proposals."""
        graph, samples = self.graph, self.held
        mixtures = [mixture for mixture in (graph.prior, *graph.proposals) if mixture is not None]
        # Any points of the space will do: nothing computed from them is NaN.
        points = mixtures[0].sample(key, samples)
        zero = jnp.zeros((graph.count, samples), points.dtype)
        edges = [jnp.zeros((len(term.plate.rows), samples), zero.dtype) for term in graph.pairs]
        messages = tuple(Directed(edge, edge) for edge in edges)
        last = tuple(
            self.come_from(term, directed, points, zero[:, 0]) for term, directed in zip(graph.pairs, messages, strict=True) if self.settings.damping
        )
        detected = jnp.zeros((*zero.shape, len(graph.proposals)), zero.dtype) if self.adapts else None
        return Beliefs(points, zero, zero, zero, messages, zero[:, 0]), Memory(self.method.begin(graph, points), last, detected)

    def proposals(self, beliefs: Beliefs, memory: Memory, power: float | Scalar) -> tuple[Proposals, Memory, Summary]:
        """Return the proposals that follow from beliefs, the memory, and figures of the beliefs. `power` is the power of the likelihood."""
        graph = self.graph
        weights, cavity = self.weigh(beliefs, power)
        fits = jax.vmap(lambda points, log_weights: fit(graph.space, jnp.exp(log_weights), points, self.settings.inflation, self.floors))(
            beliefs.points, weights
        )
        belief_proposals, method_memory = self.method.near_beliefs(graph, beliefs, weights, fits, memory.method, power)
        detections = self._shares_of_detections(beliefs, memory, weights)
        proposal = proposals(graph, beliefs, cavity, belief_proposals, self.settings.shares, self.method.is_sole_proposal, detections)
        of_messages = [jax.vmap(effective_sample_size)(log_weights) for directed in cavity for log_weights in directed]
        least = jnp.min(jnp.concatenate(of_messages)) if of_messages else jnp.asarray(float(self.held))
        sds = belief_sds(graph.space, jnp.exp(weights), beliefs.points, fits.mean)
        return proposal, memory._replace(method=method_memory), Summary(fits.mean, sds, jax.vmap(effective_sample_size)(weights), least)

    def round(self, state: tuple[Beliefs, Memory], key: Key, turn: Round) -> tuple[tuple[Beliefs, Memory], Summary]:
        """Redraw the nodes of a round and evaluate the messages into them."""
        graph, beliefs = self.graph, state[0]
        proposal, memory, summary = self.proposals(*state, turn.power)
        fresh = self.draw(key, beliefs, proposal, turn)
        redrawn = jnp.zeros(graph.count, bool).at[turn.nodes].set(True, mode="drop")
        points = jnp.where(redrawn.reshape(-1, *[1] * (fresh.ndim - 1)), fresh, beliefs.points)
        arrived = self._arrived(beliefs, proposal, points, turn)
        messages, memory = self._damped(beliefs, proposal, memory, points, arrived, turn) if self.settings.damping else (arrived, memory)
        likelihood, potential = unary_values(graph, points, turn.unary)
        prior = self._prior(graph.by_ancestor(points))
        log_q = self.log_q(beliefs, proposal, points, arrived, prior)
        if memory.detected is not None:
            parts = log_parts(graph, proposal, points, arrived, prior)[..., 2:-1]
            detected = jnp.exp(jnp.where(parts > -jnp.inf, parts - log_q[..., None], -jnp.inf))
            memory = memory._replace(detected=jnp.where(redrawn[:, None, None], detected, memory.detected))
        ready = jnp.where(redrawn & self.drawn(beliefs, proposal), 1.0, beliefs.ready)
        chosen = redrawn[:, None] & (ready[:, None] > 0)
        next_beliefs = Beliefs(
            points,
            jnp.where(chosen, log_q, beliefs.log_q),
            jnp.where(chosen, likelihood, beliefs.likelihood),
            jnp.where(chosen, potential + prior, beliefs.log_prior),
            messages,
            ready,
        )
        return (next_beliefs, memory), summary

    def weigh(self, beliefs: Beliefs, power: float | Scalar) -> tuple[NodeValues, tuple[Directed, ...]]:
        """Return the normalised log-weights of the beliefs, and those of the sources of all messages."""
        return normalised(log_beliefs(self.graph, beliefs, power)), cavities(self.graph, beliefs, power)

    def draw(self, key: Key, beliefs: Beliefs, proposal: Proposals, turn: Round) -> Float[Array, "node sample *entry"]:
        """Draw new particles; those of nodes that are not in the round are not used."""
        del beliefs, turn
        return draw(key, self.graph, proposal, self.held)

    def log_q(
        self, beliefs: Beliefs, proposal: Proposals, points: Float[Array, "node sample *entry"], arrived: tuple[Directed, ...], prior: NodeValues
    ) -> NodeValues:
        """Return the log-density of `draw`. The draws along the edges come from the messages as they arrived, before damping."""
        del beliefs
        return log_density(self.graph, proposal, points, arrived, prior)

    def come_from(self, term: Term, cavity: Directed, points: Float[Array, "node sample *entry"], ready: Float[Array, " node"]) -> Sources:
        """Return the sources of a term's messages."""
        return sources(term, cavity, points, ready)

    def drawn(self, beliefs: Beliefs, proposal: Proposals) -> Bool[Array, " node"]:
        """Return which nodes can be drawn."""
        del beliefs
        return jnp.max(proposal.shares, axis=1) > -jnp.inf

    def _shares_of_detections(self, beliefs: Beliefs, memory: Memory, weights: NodeValues) -> Float[Array, "node mixture"]:
        """Return the share of each mixture of detections: the first one, and what it brought to the belief where a node has particles."""
        first = first_shares(self.graph, self.settings.shares)
        if memory.detected is None:
            return first
        brought = jnp.einsum("ns,nsk->nk", jnp.exp(weights), memory.detected)
        return jnp.where(beliefs.ready[:, None] > 0, adapted_shares(first, brought), first)

    def _arrived(self, beliefs: Beliefs, proposal: Proposals, points: Float[Array, "node sample *entry"], turn: Round) -> tuple[Directed, ...]:
        """Return all messages. Those into the nodes of the round are evaluated at their new particles."""

        def evaluate(term: Term, closing: bool, cavity: Directed, old: Directed, rows: tuple[Array, Array]) -> Directed:
            come_from = self.come_from(term, cavity, beliefs.points, beliefs.ready)
            return entered(old, log_messages(term, come_from, points, rows, self._heard(closing)), rows)

        return tuple(map(evaluate, self.graph.pairs, self.graph.only_closing, proposal.cavities, beliefs.messages, turn.pairs))

    def _heard(self, closing: bool) -> int | None:
        return self.settings.heard if closing else None

    def _damped(
        self,
        beliefs: Beliefs,
        proposal: Proposals,
        memory: Memory,
        points: Float[Array, "node sample *entry"],
        arrived: tuple[Directed, ...],
        turn: Round,
    ) -> tuple[tuple[Directed, ...], Memory]:
        """Return the messages mixed with those from their last sources, and the memory of their current sources."""
        damping = self.settings.damping

        def damp(term: Term, closing: bool, cavity: Directed, new: Directed, last: Sources, rows: tuple[Array, Array]) -> tuple[Directed, Sources]:
            old = log_messages(term, last, points, rows, self._heard(closing))
            indices = [jnp.minimum(numbers, len(term.plate.rows) - 1) for numbers in rows]
            mixed = [
                jnp.where(ready[row][:, None] > 0, (1 - damping) * message[row] + damping * previous, message[row])
                for message, previous, ready, row in zip(new, old, last.ready, indices, strict=True)
            ]
            come_from = self.come_from(term, cavity, beliefs.points, beliefs.ready)
            return entered(new, Directed(*mixed), rows), Sources(
                *(
                    entered(old_leaf, Directed(*(leaf[row] for leaf, row in zip(new_leaf, indices, strict=True))), rows)
                    for old_leaf, new_leaf in zip(last, come_from, strict=True)
                )
            )

        damped = tuple(map(damp, self.graph.pairs, self.graph.only_closing, proposal.cavities, arrived, memory.last, turn.pairs))
        return tuple(messages for messages, _ in damped), memory._replace(last=tuple(last for _, last in damped))

    def redraw(self, key: Key, beliefs: Beliefs, proposal: Proposals) -> tuple[Redrawn, Float[Array, "node sample part"]]:
        """Return new particles of all nodes from fixed proposals, and the log of each part of their proposal."""

        def rows(term: Term) -> tuple[Array, Array]:
            every = jnp.arange(len(term.plate.rows))
            return every, every

        graph = self.graph
        points = draw(key, graph, proposal, self.settings.samples)
        messages = tuple(
            log_messages(term, sources(term, cavity, beliefs.points, beliefs.ready), points, rows(term))
            if term.plate.draw is not None and term.plate.log_draw is None
            else old
            for term, cavity, old in zip(graph.pairs, proposal.cavities, beliefs.messages, strict=True)
        )
        likelihood, potential = unary_values(graph, points)
        by_ancestor = graph.by_ancestor(points)
        parts = log_parts(graph, proposal, points, messages, self._prior(by_ancestor))
        closing = self._closing(beliefs, proposal, points)
        return Redrawn(points, likelihood + potential, by_ancestor, closing, jax.nn.logsumexp(parts, axis=-1)), parts

    def _closing(self, beliefs: Beliefs, proposal: Proposals, points: Float[Array, "node sample *entry"]) -> NodeValues:
        """Return at each point a substitute for the factors that only close loops: their messages from the node that is nearer to the root.

        A message averages the factor over particles of its source. 1 / `heard` is added to it, so that it never excludes what the factor allows.
        """
        graph, depth, heard = self.graph, np.zeros(self.graph.count), self.settings.heard
        for distance, nodes in enumerate(depths(graph)):
            depth[nodes] = distance
        total = jnp.zeros(points.shape[:2], points.dtype)
        for term, closing, cavity in zip(graph.pairs, graph.only_closing, proposal.cavities, strict=True):
            if closing:
                outwards = depth[term.rows[:, 0]] <= depth[term.rows[:, 1]]
                rows = np.flatnonzero(outwards), np.flatnonzero(~outwards)
                come_from = sources(term, cavity, beliefs.points, beliefs.ready)
                messages = log_messages(term, come_from, points, (jnp.asarray(rows[0]), jnp.asarray(rows[1])), heard)
                for column, row, values in zip((1, 0), rows, messages, strict=True):
                    total = total.at[term.rows[row, column]].add(jnp.logaddexp(values, -math.log(heard)))
        return total

    def _prior(self, by_ancestor: Float[Array, "node sample ancestor"]) -> NodeValues:
        """Return the log of every node's own prior, 0 without one. It is both a factor and a part of the proposal."""
        return jax.nn.logsumexp(by_ancestor + self.graph.log_ancestors, axis=-1)
