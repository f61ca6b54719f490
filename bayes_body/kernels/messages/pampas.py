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
from jaxtyping import Array, Bool, Float

from bayes_body.base.shapes import Key, Scalar
from bayes_body.density.graph import Graph
from bayes_body.kernels.messages.messages import Beliefs, Directed, NodeValues, cavities, log_beliefs, normalised
from bayes_body.kernels.messages.node_proposals import Proposals, Shares, draw, log_density, proposals
from bayes_body.kernels.messages.passing import Passing, Settings
from bayes_body.kernels.messages.products import Product, draw_products, slots_of, ways

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
        self.of_beliefs = np.concatenate([np.where(degree > 0, HALF, 1.0), HALF * exists / np.maximum(degree, 1)], axis=1)

    def weigh(self, beliefs: Beliefs, power: float | Scalar) -> tuple[NodeValues, tuple[Directed, ...]]:
        """Return the log-weights of the beliefs and of the messages, normalised within each stratum."""
        weights = stratified(log_beliefs(self.graph, beliefs, power), jnp.asarray(self.of_beliefs))
        message_weights, number = [], 0
        for term, raw in zip(self.graph.pairs, cavities(self.graph, beliefs, power), strict=True):
            count = len(term.rows)
            if term.plate.draw is None:
                shares = [jnp.asarray(self.of_beliefs)[term.rows[:, column]] for column in (0, 1)]
            else:
                # The stratum of a message leaves out the slot, in the source, of the message in the other direction along the same row.
                shares = [self._of_message(number + count + np.arange(count)), self._of_message(number + np.arange(count))]
                number += 2 * count
            message_weights.append(Directed(*(stratified(log_weights, share) for log_weights, share in zip(raw, shares, strict=True))))
        return weights, tuple(message_weights)

    def _of_message(self, answers: np.ndarray) -> Float[Array, "edge stratum"]:
        """Return the shares of the strata in messages, given the numbers of the messages in the other direction."""
        return jnp.asarray(HALF * (np.eye(self.strata)[0] + np.eye(self.strata)[1 + self._places(answers)[1]]))

    def _places(self, numbers: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the target nodes of messages, and their slots there."""
        places = np.array([np.argwhere(self.slots == number)[0] for number in numbers])
        return places[:, 0], places[:, 1]

    def first(self, beliefs: Beliefs, proposal: Proposals) -> Proposals:
        """Return the proposal of particles that do not come from messages: prior and detections."""
        return proposals(
            self.graph, beliefs._replace(ready=jnp.zeros_like(beliefs.ready)), proposal.cavities, proposal.belief_proposals, FIRST, False
        )

    def draw(self, key: Key, beliefs: Beliefs, proposal: Proposals) -> Float[Array, "node sample *entry"]:
        """Draw the particles of all strata."""
        first_key, product_key = jax.random.split(key)
        otherwise = draw(first_key, self.graph, self.first(beliefs, proposal), self.held)
        if self.strata == 1:
            return otherwise
        return draw_products(product_key, self.graph, self._product(beliefs, proposal), otherwise)

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

    def _product(self, beliefs: Beliefs, proposal: Proposals) -> Product:
        """Return the messages, with only the particles in their strata, and the slots that each sample multiplies."""
        points, weights, number = [], [], 0
        cavity_of = dict(zip(map(id, self.graph.pairs), proposal.cavities, strict=True))
        for way in ways(self.graph):
            count = len(way.targets)
            node, slot = self._places(number + (-count if way.reverse else count) + np.arange(count))
            within = np.arange(self.each)
            index = jnp.asarray(np.concatenate([np.tile(within, (count, 1)), (1 + slot)[:, None] * self.each + within], axis=1))
            points.append(jax.vmap(lambda node_points, indices: node_points[indices])(beliefs.points[node], index))
            weights.append(jnp.take_along_axis(cavity_of[id(way.term)][way.reverse], index, axis=1))
            number += count
        return Product(jnp.concatenate(points), jnp.concatenate(weights), self.slots, self._taken(beliefs))


def stratified(log_weights: Float[Array, "row sample"], shares: Float[Array, "row stratum"]) -> Float[Array, "row sample"]:
    """Return log-weights such that the weights of each stratum sum to its share. The share of a stratum without weight goes to the others."""
    strata = jnp.where(jnp.isnan(log_weights), -jnp.inf, log_weights).reshape(*shares.shape, -1)
    alive = (jnp.max(strata, axis=2) > -jnp.inf) & (jnp.max(strata, axis=2) < jnp.inf)
    share = jnp.where(alive, shares, 0.0)
    log_share = jnp.where(share > 0, jnp.log(share), -jnp.inf)[..., None]
    return normalised(jnp.where(share[..., None] > 0, normalised(strata) + log_share, -jnp.inf).reshape(log_weights.shape))
