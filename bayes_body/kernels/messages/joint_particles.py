r"""Joint draws of all nodes, and the evidence, from particle belief propagation.

All nodes are redrawn at once from fixed proposals. On these points, the sum over a forest of edges and the ancestors a of the prior is exact. A pass
upwards gives the evidence. A pass downwards draws an ancestor, and then a point of each node given the ancestor and the parent's point. With S points
per node,

$$\hat Z = S^{-V} \sum_a w_a \sum_{n_1 \ldots n_V} \prod_i \frac{\phi_i(x_i^{n_i})\, \pi_{ia}(x_i^{n_i})}{q_i(x_i^{n_i})}
\prod_{(i, j) \in \text{forest}} \psi_{ij}$$

is unbiased. The sum is one product of matrices for each edge, (S, S) by (S, A). The draws have equal weights if the graph is the forest. Edges that
close loops, and terms of more than two nodes, enter by the weights of the draws, and the mean weight times $\hat Z$ is still unbiased. In the sum,
messages may replace the edges that close loops. The weights are then the ratio of these edges' factors to the messages.
"""

from collections.abc import Mapping
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from bayes_body.base.inverse_cdf import inverse_cdf
from bayes_body.base.shapes import Key, Scalar
from bayes_body.density.graph import Graph, Term
from bayes_body.kernels.batching import ROWS, over_particles
from bayes_body.kernels.messages.messages import NodeValues, normalised, without_nan

type Table = Float[Array, "node sample ancestor"]


class Redrawn(NamedTuple):
    """Points of all nodes from fixed proposals.

    Attributes:
        points: the points.
        unary: log of the factors of one node, without the prior.
        by_ancestor: log of the prior given each ancestor.
        closing: log of a substitute for factors that close loops. The draws follow the substitute, and their weights replace it by the factors.
        log_q: log-density of the proposals.
    """

    points: Float[Array, "node sample *entry"]
    unary: NodeValues
    by_ancestor: Table
    closing: NodeValues
    log_q: NodeValues


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


def joint_particles(key: Key, graph: Graph, redrawn: Redrawn, count: int) -> JointParticles:
    """Return `count` joint draws.

    Args:
        key: random key.
        graph: the graph.
        redrawn: points of each node.
        count: number of draws.
    """
    points, forest = redrawn.points, _rooted(graph)
    pairs = _forest_pairs(graph, forest, points)
    tables = (redrawn.unary + redrawn.closing - redrawn.log_q - jnp.log(points.shape[1]))[..., None] + redrawn.by_ancestor
    tables = jnp.where(jnp.isnan(tables), -jnp.inf, tables)
    upward, messages = jax.lax.scan(_up, tables, (pairs, forest.parents, forest.children), reverse=True)
    of_roots = jax.nn.logsumexp(upward[forest.roots], axis=1)
    of_ancestors = graph.log_ancestors + jnp.sum(of_roots, axis=0)
    # A root's own tree is counted in its table already.
    exact = upward.at[forest.roots].add(jnp.where(jnp.isfinite(of_roots), of_ancestors - of_roots, -jnp.inf)[:, None])
    exact, _ = jax.lax.scan(_down, exact, (pairs, messages, forest.parents, forest.children))
    chosen = _chosen(key, forest, pairs, upward, of_ancestors, count)
    values = jax.vmap(lambda node_points, index: node_points[index], out_axes=1)(points, chosen)
    left_out = over_particles(lambda value, graph: log_left_out(graph, value), values, graph)
    stood_in = jnp.sum(jnp.take_along_axis(redrawn.closing, chosen, axis=1), axis=0)
    weights = jax.nn.logsumexp(of_ancestors) + left_out - stood_in
    beliefs = normalised(jax.nn.logsumexp(exact, axis=-1))
    return JointParticles(values, jnp.where(jnp.isnan(weights), -jnp.inf, weights), points, beliefs)


def _chosen(
    key: Key, forest: "Forest", pairs: Float[Array, "edge parent child"], upward: Table, of_ancestors: Float[Array, " ancestor"], count: int
) -> Int[Array, "node draw"]:
    """Draw an ancestor, and given it a point of every node, from the roots downwards."""
    ancestor_key, root_key, edge_key = jax.random.split(key, 3)
    ancestor = _pick(ancestor_key, jnp.broadcast_to(of_ancestors, (count, len(of_ancestors))))
    roots = jax.vmap(lambda key, table: _pick(key, table[:, ancestor].T))(jax.random.split(root_key, len(forest.roots)), upward[forest.roots])
    start = jnp.zeros((upward.shape[0], count), int).at[forest.roots].set(roots)

    def choose(chosen: Array, edge: tuple[Key, Array, Array, Array]) -> tuple[Array, None]:
        key, matrix, parent, child = edge
        return chosen.at[child].set(_pick(key, matrix[chosen[parent]] + upward[child][:, ancestor].T)), None

    chosen, _ = jax.lax.scan(choose, start, (jax.random.split(edge_key, len(forest.parents)), pairs, forest.parents, forest.children))
    return chosen


def log_left_out(graph: Graph, value: Float[Array, "node *entry"]) -> Scalar:
    """Return the log of what the sum over the forest leaves out: edges that close loops, and terms of more than two nodes."""
    summed, total = set(graph.forest()), graph.log_rest(value)
    for number, term in enumerate(graph.pairs):
        rows = [row for row in range(len(term.plate.rows)) if (number, row) not in summed]
        if rows:
            index = jnp.asarray(rows)
            nodes, parameters = jnp.asarray(term.rows)[index], jax.tree.map(lambda leaf, index=index: leaf[index], term.plate.parameters)
            total += jnp.sum(jax.vmap(term.log_potential)(parameters, value[nodes[:, 0]], value[nodes[:, 1]]))
    return total


def _up(table: Table, edge: tuple[Array, Array, Array]) -> tuple[Table, Float[Array, "sample ancestor"]]:
    """Add the message of a child to the table of its parent."""
    matrix, parent, child = edge
    message = _log_product(matrix, table[child])
    return table.at[parent].add(message), message


def _down(table: Table, edge: tuple[Array, Array, Array, Array]) -> tuple[Table, None]:
    """Add the message of a parent, without the message from the child, to the table of the child."""
    matrix, message, parent, child = edge
    without = table[parent] - jnp.where(jnp.isfinite(message), message, jnp.inf)
    return table.at[child].add(_log_product(matrix.T, without)), None


def _log_product(matrix: Float[Array, "row middle"], table: Float[Array, "middle column"]) -> Float[Array, "row column"]:
    """Return the log of the matrix product of the exponentials. Terms that are e^-87 of the largest of their row and column, or less, are lost."""
    highest = _finite(jnp.max(table, axis=0))
    of_middle = _finite(jnp.max(table - highest, axis=1))
    of_row = _finite(jnp.max(matrix + of_middle, axis=1, keepdims=True))
    product = jnp.exp(matrix + of_middle - of_row) @ jnp.exp(table - highest - of_middle[:, None])
    return jnp.log(product) + of_row + highest


def _finite(peak: Array) -> Array:
    return jnp.where(jnp.isfinite(peak), peak, 0.0)


def _pick(key: Key, log_weights: Float[Array, "draw sample"]) -> Int[Array, " draw"]:
    """Draw an index of each row by weight, at levels that are spread evenly over the draws."""
    count = log_weights.shape[0]
    weights = jnp.exp(log_weights - jnp.max(log_weights, axis=1, keepdims=True))
    cumulative = jnp.cumsum(weights, axis=1)
    within, order = jax.random.split(key)
    levels = jax.random.permutation(order, (jnp.arange(count) + jax.random.uniform(within, (count,))) / count)
    return jax.vmap(inverse_cdf)(cumulative, levels)


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
    remaining, visited, roots = dict(nodes_of), set[int](), list[int]()
    order: list[tuple[tuple[int, int], int, int]] = []
    while remaining or len(visited) < graph.count:
        next_edge = next((edge for edge, nodes in remaining.items() if visited & set(nodes)), None)
        if next_edge is None:
            roots.append(min((node for node in range(graph.count) if node not in visited), key=lambda node: (-_degree(nodes_of, node), node)))
            visited.add(roots[-1])
            continue
        first, second = remaining.pop(next_edge)
        parent, child = (first, second) if first in visited else (second, first)
        order.append((next_edge, parent, child))
        visited.add(child)
    turned = tuple(nodes_of[edge][0] != parent for edge, parent, _ in order)
    parents, children = (jnp.asarray([edge[k] for edge in order], int) for k in (1, 2))
    return Forest(tuple(edge for edge, *_ in order), turned, parents, children, jnp.asarray(roots, int))


def _degree(edges: Mapping[tuple[int, int], tuple[int, ...]], node: int) -> int:
    return sum(node in nodes for nodes in edges.values())


def _forest_pairs(graph: Graph, forest: Forest, points: Float[Array, "node sample *entry"]) -> Float[Array, "edge parent child"]:
    """Return the log-potentials of all pairs of points along every edge."""
    matrix_of: dict[tuple[int, int], Array] = {}
    for number, term in enumerate(graph.pairs):
        rows = [row for term_number, row in forest.edges if term_number == number]
        if not rows:
            continue
        matrices = over_particles(_of_edge, jnp.asarray(rows), (term, points), ROWS)
        matrix_of |= {(number, row): matrix for row, matrix in zip(rows, matrices, strict=True)}
    ordered = [matrix_of[edge].T if turned else matrix_of[edge] for edge, turned in zip(forest.edges, forest.turned, strict=True)]
    samples = points.shape[1]
    return jnp.stack(ordered) if ordered else jnp.zeros((0, samples, samples), points.dtype)


def _of_edge(row: Int[Array, ""], shared: tuple[Term, Array]) -> Float[Array, "first second"]:
    term, points = shared
    first, second = jnp.asarray(term.rows)[row]
    parameters = jax.tree.map(lambda leaf: leaf[row], term.plate.parameters)
    return without_nan(term.pairwise(parameters, points[first], points[second]))
