r"""Particle message passing in strata (PAMPAS: Isard 2003; Sigal et al. 2011, 7): the method `pampas`.

The particles of a message from i to j are drawn from two importance functions, half of them from each:

$$q^{(1)}_{ij} = \prod_{k \ne j} m_{ki}, \qquad q^{(2)}_i = \prod_k m_{ki},$$

where the products are over messages along which values are proposed (kernels/messages/products.py). The weights are $m^F_{ij} / q$ with the message
foundation $m^F_{ij} = \phi_i \prod_{k \ne j} m_{ki}$. Both functions are known only up to a constant, so the weights of each stratum are normalised
to its share. This is not an exact balance of the strata: a stratum that misses a peak has the same share as one that finds it. In the first
iteration, and where there is no other message, particles come from the prior (share 0.9, the paper's $q^{(4)}$) and detections (0.1, $q^{(3)}$).

The particles of a node are one stratum of $q^{(2)}$, which all its messages share, and one of $q^{(1)}$ for each neighbour, which only the message to
this neighbour uses. Half of `samples` are in each stratum. The paper takes fewer for parts with many joints, and adds a broad component of weight
0.001 to every message; neither is done here. The motion prior is a factor of $\phi_i$.

The strata give no evidence. The joint draws and their evidence are those of the other methods: all nodes are redrawn from mixtures of these messages
and a normal fit to the belief, whose density is exact.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from bayes_body.base.shapes import Key, Scalar
from bayes_body.density.graph import Graph, Term
from bayes_body.kernels.messages.messages import Beliefs, Directed, NodeValues, Sources, cavities, log_beliefs, normalised
from bayes_body.kernels.messages.node_proposals import Proposals, Shares, draw, log_density, proposals
from bayes_body.kernels.messages.passing import Passing, Settings
from bayes_body.kernels.messages.products import Product, draw_products, slots_of, ways
from bayes_body.kernels.messages.schedules import Round

# The shares of previous frame and detections among the first particles, and those of both importance functions afterwards.
FIRST = Shares(messages=0.0, prior=0.9, detections=0.1, fit=0.0)
HALF = 0.5


class Pampas(Passing):
    """The computations of a round in strata. The first stratum of a node is that of all messages; stratum 1 + k leaves out slot k."""

    def __init__(self, graph: Graph, settings: Settings):
        """Take the graph and the settings. `samples` are the particles of a message; `shares` are those of the joint draws' proposals."""
        super().__init__(graph, settings)
        # The common proposal is that of the joint draws alone.
        self.adapts = False
        self.slots = slots_of(graph)
        self.each, self.strata = max(settings.samples // 2, 1), 1 + self.slots.shape[1]
        self.held = self.each * self.strata
        exists = self.slots < sum(len(way.targets) for way in ways(graph))
        # Which slots each stratum multiplies: (node, stratum, slot).
        self.taken = exists[:, None] & ~np.eye(self.strata, self.strata - 1, -1, bool)
        degree = exists.sum(1, keepdims=True)
        self.left_out = self._left_out()
        self.of_beliefs = np.concatenate([np.where(degree > 0, HALF, 1.0), HALF * exists / np.maximum(degree, 1)], axis=1)

    def _left_out(self) -> dict[int, tuple[np.ndarray, np.ndarray]]:
        """Return the slots, in its source, that the second stratum of each message leaves out: those of the messages back.

        By `id` of the term, for the messages to the second node of each row, and for those to the first.
        """
        numbers = 1 + sum(len(way.targets) for way in ways(self.graph))
        slot_of, left_out, start = np.zeros(numbers, int), dict[int, tuple[np.ndarray, np.ndarray]](), 0
        slot_of[self.slots] = np.arange(self.slots.shape[1])
        for term in (term for term in self.graph.pairs if term.plate.draw is not None):
            towards_second, towards_first = np.split(slot_of[start : start + 2 * len(term.rows)], 2)
            left_out[id(term)] = towards_first, towards_second
            start += 2 * len(term.rows)
        return left_out

    def weigh(self, beliefs: Beliefs, power: float | Scalar) -> tuple[NodeValues, tuple[Directed, ...]]:
        """Return the log-weights of the beliefs and of the messages, normalised within each stratum."""
        weights = stratified(log_beliefs(self.graph, beliefs, power), jnp.asarray(self.of_beliefs))
        message_weights = []
        for term, raw in zip(self.graph.pairs, cavities(self.graph, beliefs, power), strict=True):
            if term.plate.draw is None:
                shares = [jnp.asarray(self.of_beliefs)[term.rows[:, column]] for column in (0, 1)]
            else:
                shares = [jnp.asarray(HALF * (np.eye(self.strata)[0] + np.eye(self.strata)[1 + left_out])) for left_out in self.left_out[id(term)]]
            message_weights.append(Directed(*(stratified(log_weights, share) for log_weights, share in zip(raw, shares, strict=True))))
        return weights, tuple(message_weights)

    def first(self, beliefs: Beliefs, proposal: Proposals) -> Proposals:
        """Return the proposal of particles that do not come from messages: prior and detections."""
        return proposals(
            self.graph, beliefs._replace(ready=jnp.zeros_like(beliefs.ready)), proposal.cavities, proposal.belief_proposals, FIRST, False
        )

    def draw(self, key: Key, beliefs: Beliefs, proposal: Proposals, turn: Round) -> Float[Array, "node sample *entry"]:
        """Draw the particles of all strata; those of nodes that are not in the round are not used."""
        first_key, product_key = jax.random.split(key)
        otherwise = draw(first_key, self.graph, self.first(beliefs, proposal), self.held)
        if self.strata == 1:
            return otherwise
        nodes = jnp.minimum(turn.nodes, self.graph.count - 1)
        products = draw_products(product_key, self.graph, self._product(beliefs, proposal, turn, nodes), otherwise[nodes])
        return otherwise.at[turn.nodes].set(products, mode="drop")

    def come_from(self, term: Term, cavity: Directed, points: Float[Array, "node sample *entry"], ready: Float[Array, " node"]) -> Sources:
        """Return the sources of a term's messages. A message along which values are proposed has two strata; all others have no weight in it."""
        every = super().come_from(term, cavity, points, ready)
        if term.plate.draw is None:
            return every
        within = np.arange(self.each)

        def in_strata(values: Directed) -> Directed:
            index = [
                np.concatenate([np.tile(within, (len(slots), 1)), (1 + slots)[:, None] * self.each + within], axis=1)
                for slots in self.left_out[id(term)]
            ]
            return Directed(*(values_of_way[np.arange(len(chosen))[:, None], chosen] for values_of_way, chosen in zip(values, index, strict=True)))

        return Sources(in_strata(every.points), in_strata(every.weights), every.ready)

    def log_q(
        self, beliefs: Beliefs, proposal: Proposals, points: Float[Array, "node sample *entry"], arrived: tuple[Directed, ...], prior: NodeValues
    ) -> NodeValues:
        """Return the log of every stratum's importance function; infinite where nothing was drawn."""
        exact = log_density(self.graph, self.first(beliefs, proposal), points, arrived, prior)
        exact = jnp.where(exact > -jnp.inf, exact, jnp.inf)
        if self.strata == 1:
            return exact
        taken = self._taken(beliefs)
        pairs = zip(self.graph.pairs, arrived, strict=True)
        sent = jnp.concatenate([message for term, directed in pairs if term.plate.draw is not None for message in directed])
        into = jnp.moveaxis(sent[np.minimum(self.slots, len(sent) - 1)], 1, 2)
        return jnp.where(jnp.max(taken, axis=2) > 0, jnp.sum(jnp.where(taken > 0, into, 0.0), axis=2), exact)

    def drawn(self, beliefs: Beliefs, proposal: Proposals) -> Bool[Array, " node"]:
        """Return which nodes can be drawn: those with a first proposal or a message."""
        has_proposal = jnp.max(self.first(beliefs, proposal).shares, axis=1) > -jnp.inf
        return has_proposal | (jnp.max(self._taken(beliefs), axis=(1, 2), initial=0.0) > 0)

    def _taken(self, beliefs: Beliefs) -> Float[Array, "node sample slot"]:
        """Return which slots the stratum of every particle multiplies, without those whose source has no particles."""
        ready = jnp.concatenate([beliefs.ready[way.term.rows[:, 1 if way.reverse else 0]] for way in ways(self.graph)])
        slot_ready = ready[np.minimum(self.slots, len(ready) - 1)]
        return jnp.repeat(self.taken * slot_ready[:, None], self.each, axis=1)

    def _product(self, beliefs: Beliefs, proposal: Proposals, turn: Round, nodes: Int[Array, " own"]) -> Product:
        """Return the messages into the nodes of a round, with only the particles in their strata, and the slots that each sample multiplies."""
        rows, points, weights, numbers, start = [], [], [], [], 0
        for term, cavity, by_direction in zip(self.graph.pairs, proposal.cavities, turn.pairs, strict=True):
            if term.plate.draw is None:
                continue
            come_from, count = self.come_from(term, cavity, beliefs.points, beliefs.ready), len(term.rows)
            for reverse in (False, True):
                chosen = jnp.minimum(by_direction[reverse], count - 1)
                rows.append(chosen)
                points.append(come_from.points[reverse][chosen])
                weights.append(come_from.weights[reverse][chosen])
                numbers.append(start + chosen)
                start += count
        number = jnp.concatenate(numbers)
        targets = jnp.asarray(np.concatenate([way.targets for way in ways(self.graph)]))[number]
        return Product(
            tuple(rows),
            jnp.concatenate(points),
            jnp.concatenate(weights),
            jnp.argmax(targets[:, None] == nodes, axis=1),
            jnp.argmax(jnp.asarray(self.slots)[nodes][..., None] == number, axis=2),
            self._taken(beliefs)[nodes],
        )


def stratified(log_weights: Float[Array, "row sample"], shares: Float[Array, "row stratum"]) -> Float[Array, "row sample"]:
    """Return log-weights such that the weights of each stratum sum to its share. The share of a stratum without weight goes to the others."""
    strata = jnp.where(jnp.isnan(log_weights), -jnp.inf, log_weights).reshape(*shares.shape, -1)
    alive = (jnp.max(strata, axis=2) > -jnp.inf) & (jnp.max(strata, axis=2) < jnp.inf)
    share = jnp.where(alive, shares, 0.0)
    log_share = jnp.where(share > 0, jnp.log(share), -jnp.inf)[..., None]
    return normalised(jnp.where(share[..., None] > 0, normalised(strata) + log_share, -jnp.inf).reshape(log_weights.shape))
