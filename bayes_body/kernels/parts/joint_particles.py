r"""Joint draws of all nodes, and the evidence, from particle belief propagation.

All nodes are redrawn at once from fixed proposals. On these points a forest of edges is summed exactly: upwards for the evidence, and downwards by
drawing a point of each node given its parent's. With S points a node,

$$\hat Z = S^{-V} \sum_{n_1 \ldots n_V} \prod_i \frac{\phi_i(x_i^{n_i})}{q_i(x_i^{n_i})} \prod_{(i, j) \in \text{forest}} \psi_{ij}$$

is unbiased. The draws have equal weights if the graph is the forest. Edges that close loops, and terms that are not pairwise, enter by the weights
$p(x) / \prod \phi\, \psi$ of the draws, and the mean weight times $\hat Z$ is still unbiased.
"""

from collections.abc import Mapping
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from bayes_body.density.graph import Graph
from bayes_body.kernels.parts.batching import over_particles
from bayes_body.kernels.parts.messages import NodeValues, normalised, without_nan
from bayes_body.shapes import Key, Scalar


class JointParticles(NamedTuple):
    """Weighted draws of the values of all nodes.

    Attributes:
        values: the draws.
        log_weights: their log-weights, not normalised; their mean is an estimate of the evidence.
        points: the points of each node.
        log_beliefs: log-weights of the points in the exact belief of their node on the forest.
    """

    values: Float[Array, "draw node *entry"]
    log_weights: Float[Array, " draw"]
    points: Float[Array, "node sample *entry"]
    log_beliefs: NodeValues

    @property
    def log_evidence(self) -> Scalar:
        """The log of the mean weight."""
        return jax.nn.logsumexp(self.log_weights) - jnp.log(self.log_weights.shape[0])


def joint_particles(
    key: Key, graph: Graph, points: Float[Array, "node sample *entry"], unary: NodeValues, log_q: NodeValues, count: int
) -> JointParticles:
    """Return `count` joint draws on points that were drawn from proposals with the log-density `log_q`.

    Args:
        key: random key.
        graph: the graph.
        points: points of each node.
        unary: log of the factors of one node.
        log_q: log-density of the proposals.
        count: number of draws.
    """
    nodes, samples = points.shape[:2]
    forest = _rooted(graph)
    pairs = _forest_pairs(graph, forest, points)
    alone = unary - log_q - jnp.log(samples)
    upward, messages = jax.lax.scan(_up, alone, (pairs, forest.parents, forest.children), reverse=True)
    exact, _ = jax.lax.scan(_down, upward, (pairs, messages, forest.parents, forest.children))
    log_z = jnp.sum(jax.nn.logsumexp(upward[forest.roots], axis=1))

    root_key, edge_key = jax.random.split(key)
    pick_roots = jax.vmap(lambda key, weights: _pick(key, jnp.broadcast_to(weights, (count, samples))))
    chosen = jnp.zeros((nodes, count), int).at[forest.roots].set(pick_roots(jax.random.split(root_key, len(forest.roots)), upward[forest.roots]))

    def choose(state: tuple[Array, Array], edge: tuple[Key, Array, Array, Array]) -> tuple[tuple[Array, Array], None]:
        key, matrix, parent, child = edge
        given = matrix[state[0][parent]]
        index = _pick(key, given + upward[child][None])
        return (state[0].at[child].set(index), state[1] + jnp.take_along_axis(given, index[:, None], axis=1)[:, 0]), None

    of_edges = jnp.zeros(count, unary.dtype)
    edge_keys = jax.random.split(edge_key, len(forest.parents))
    (chosen, of_edges), _ = jax.lax.scan(choose, (chosen, of_edges), (edge_keys, pairs, forest.parents, forest.children))
    values = jax.vmap(lambda own, index: own[index], out_axes=1)(points, chosen)
    of_nodes = jnp.sum(jnp.take_along_axis(unary, chosen, axis=1), axis=0)
    target = over_particles(lambda value, graph: graph.log_density(value), values, graph)
    weights = log_z + target - of_nodes - of_edges
    return JointParticles(values, jnp.where(jnp.isnan(weights), -jnp.inf, weights), points, normalised(exact))


def _up(weights: NodeValues, edge: tuple[Array, Array, Array]) -> tuple[NodeValues, Float[Array, " sample"]]:
    """Add the message of a child to the weights of its parent."""
    matrix, parent, child = edge
    message = jax.nn.logsumexp(matrix + weights[child][None], axis=1)
    return weights.at[parent].add(message), message


def _down(weights: NodeValues, edge: tuple[Array, Array, Array, Array]) -> tuple[NodeValues, None]:
    """Add the message of a parent, without what came from the child, to the weights of the child."""
    matrix, message, parent, child = edge
    without = weights[parent] - jnp.where(jnp.isfinite(message), message, jnp.inf)
    return weights.at[child].add(jax.nn.logsumexp(matrix + without[:, None], axis=0)), None


def _pick(key: Key, log_weights: Float[Array, "draw sample"]) -> Int[Array, " draw"]:
    """Draw an index of each row by weight, at levels that are spread evenly over the draws."""
    count = log_weights.shape[0]
    weights = jnp.exp(log_weights - jnp.max(log_weights, axis=1, keepdims=True))
    cumulative = jnp.cumsum(weights, axis=1)
    within, order = jax.random.split(key)
    levels = jax.random.permutation(order, (jnp.arange(count) + jax.random.uniform(within, (count,))) / count)
    found = jax.vmap(lambda sums, level: jnp.searchsorted(sums, level * sums[-1], side="right"))(cumulative, levels)
    return jnp.minimum(found, log_weights.shape[1] - 1)


class Forest(NamedTuple):
    """The forest's edges, parents first.

    Attributes:
        edges: for each edge, the term and its row.
        turned: whether the second node of the row is the parent.
        parents: parent nodes.
        children: child nodes.
        roots: nodes without a parent.
    """

    edges: tuple[tuple[int, int], ...]
    turned: tuple[bool, ...]
    parents: Int[Array, " edge"]
    children: Int[Array, " edge"]
    roots: Int[Array, " root"]


def _rooted(graph: Graph) -> Forest:
    nodes_of = {(number, row): graph.pairs[number].plate.rows[row] for number, row in graph.forest()}
    left, known, roots = dict(nodes_of), set[int](), list[int]()
    order: list[tuple[tuple[int, int], int, int]] = []
    while left or len(known) < graph.count:
        found = next((edge for edge, nodes in left.items() if known & set(nodes)), None)
        if found is None:
            roots.append(min((node for node in range(graph.count) if node not in known), key=lambda node: (-_degree(nodes_of, node), node)))
            known.add(roots[-1])
            continue
        first, second = left.pop(found)
        parent, child = (first, second) if first in known else (second, first)
        order.append((found, parent, child))
        known.add(child)
    turned = tuple(nodes_of[edge][0] != parent for edge, parent, _ in order)
    parents, children = (jnp.asarray([edge[k] for edge in order], int) for k in (1, 2))
    return Forest(tuple(edge for edge, *_ in order), turned, parents, children, jnp.asarray(roots, int))


def _degree(edges: Mapping[tuple[int, int], tuple[int, ...]], node: int) -> int:
    return sum(node in nodes for nodes in edges.values())


def _forest_pairs(graph: Graph, forest: Forest, points: Float[Array, "node sample *entry"]) -> Float[Array, "edge parent child"]:
    """Return the log-potentials of all pairs of points along every edge."""
    found: dict[tuple[int, int], Array] = {}
    for number, term in enumerate(graph.pairs):
        rows = [row for own, row in forest.edges if own == number]
        if not rows:
            continue
        some = jnp.asarray(rows)
        nodes = jnp.asarray(term.rows)[some]
        parameters = jax.tree.map(lambda leaf, some=some: leaf[some], term.plate.parameters)
        matrices = without_nan(jax.vmap(term.pairwise)(parameters, points[nodes[:, 0]], points[nodes[:, 1]]))
        found |= {(number, row): matrix for row, matrix in zip(rows, matrices, strict=True)}
    ordered = [found[edge].T if turned else found[edge] for edge, turned in zip(forest.edges, forest.turned, strict=True)]
    samples = points.shape[1]
    return jnp.stack(ordered) if ordered else jnp.zeros((0, samples, samples), points.dtype)
