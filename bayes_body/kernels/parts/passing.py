"""A round of particle belief propagation: nodes are redrawn from their proposals, and the messages into them are evaluated."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from bayes_body.density.graph import Graph, Term
from bayes_body.kernels.parts.joint_particles import Redrawn
from bayes_body.kernels.parts.message_diagnostics import Summary, belief_sds
from bayes_body.kernels.parts.messages import Beliefs, Directed, NodeValues, cavities, entered, log_beliefs, log_messages, normalised, unary_values
from bayes_body.kernels.parts.node_proposals import FLOORS, Proposals, Shares, draw, log_density, log_parts, proposals
from bayes_body.kernels.parts.schedules import Round
from bayes_body.kernels.parts.weights import effective_sample_size
from bayes_body.shapes import Key, Scalar


class Passing:
    """The computations of a round on one graph."""

    def __init__(self, graph: Graph, samples: int, heard: int, shares: Shares, inflation: float):
        """Take the graph and the options.

        Args:
            graph: the graph.
            samples: number of particles of a node.
            heard: number of those that represent it in messages of factors that only close loops.
            shares: the shares of a node's proposal.
            inflation: factor of the covariance of the fit.
        """
        self.graph, self.samples, self.heard, self.shares, self.inflation = graph, samples, heard, shares, inflation
        self.floors = jnp.array([FLOORS.get(unit, 0.0) for unit in graph.space.tangent_units])

    def begin(self, key: Key) -> Beliefs:
        """Return nodes that are not ready: messages from them say nothing yet, and their first round draws them from prior and proposals."""
        graph, samples = self.graph, self.samples
        mixtures = [mixture for mixture in (graph.prior, *graph.proposals) if mixture is not None]
        # Only points of the space, so that nothing computed from them is NaN.
        points = mixtures[0].sample(key, samples)
        zero = jnp.zeros((graph.count, samples), points.dtype)
        edges = [jnp.zeros((len(term.plate.rows), samples), zero.dtype) for term in graph.pairs]
        return Beliefs(points, zero, zero, zero, tuple(Directed(edge, edge) for edge in edges), zero[:, 0])

    def proposals(self, beliefs: Beliefs, power: float | Scalar) -> tuple[Proposals, Summary]:
        """Return the proposals that follow from beliefs, and figures of the beliefs. `power` is that of the likelihood."""
        weights, cavity = normalised(log_beliefs(self.graph, beliefs, power)), cavities(self.graph, beliefs, power)
        own = proposals(self.graph, beliefs, weights, cavity, self.shares, self.inflation, self.floors)
        of_messages = [jax.vmap(effective_sample_size)(each) for both in cavity for each in both]
        least = jnp.min(jnp.concatenate(of_messages)) if of_messages else jnp.asarray(float(self.samples))
        sds = belief_sds(self.graph.space, jnp.exp(weights), beliefs.points, own.fits.mean)
        return own, Summary(own.fits.mean, sds, jax.vmap(effective_sample_size)(weights), least)

    def round(self, beliefs: Beliefs, key: Key, now: Round) -> tuple[Beliefs, Summary]:
        """Redraw the nodes of a round and evaluate the messages into them."""
        graph = self.graph
        own, summary = self.proposals(beliefs, now.power)
        fresh = draw(key, graph, own, self.samples)
        redrawn = jnp.zeros(graph.count, bool).at[now.nodes].set(True, mode="drop")
        points = jnp.where(redrawn.reshape(-1, *[1] * (fresh.ndim - 1)), fresh, beliefs.points)
        messages = tuple(
            entered(old, log_messages(term, cavity, beliefs.points, points, beliefs.ready, rows, self.heard if closing else None), rows)
            for term, closing, cavity, old, rows in zip(graph.pairs, graph.only_closing, own.cavities, beliefs.messages, now.pairs, strict=True)
        )
        likelihood, rest = unary_values(graph, points, now.unary)
        prior = self._prior(graph.by_ancestor(points))
        log_q = log_density(graph, own, points, messages, prior)
        ready = jnp.where(redrawn & (jnp.max(own.shares, axis=1) > -jnp.inf), 1.0, beliefs.ready)
        chosen = redrawn[:, None] & (ready[:, None] > 0)
        return Beliefs(
            points,
            jnp.where(chosen, log_q, beliefs.log_q),
            jnp.where(chosen, likelihood, beliefs.likelihood),
            jnp.where(chosen, rest + prior, beliefs.rest),
            messages,
            ready,
        ), summary

    def redraw(self, key: Key, beliefs: Beliefs, own: Proposals) -> tuple[Redrawn, Float[Array, "node sample part"]]:
        """Return new particles of all nodes from fixed proposals, and the log of each part of their proposal."""

        def rows(term: Term) -> tuple[Array, Array]:
            every = jnp.arange(len(term.plate.rows))
            return every, every

        graph = self.graph
        points = draw(key, graph, own, self.samples)
        messages = tuple(
            log_messages(term, cavity, beliefs.points, points, beliefs.ready, rows(term))
            if term.plate.draw is not None and term.plate.log_draw is None
            else old
            for term, cavity, old in zip(graph.pairs, own.cavities, beliefs.messages, strict=True)
        )
        likelihood, rest = unary_values(graph, points)
        by_ancestor = graph.by_ancestor(points)
        parts = log_parts(graph, own, points, messages, self._prior(by_ancestor))
        return Redrawn(points, likelihood + rest, by_ancestor, jax.nn.logsumexp(parts, axis=-1)), parts

    def _prior(self, by_ancestor: Float[Array, "node sample ancestor"]) -> NodeValues:
        """Return the log of every node's own prior, 0 without one. It is both a factor and a part of the proposal."""
        return jax.nn.logsumexp(by_ancestor + self.graph.log_ancestors, axis=-1)
