r"""Nested draws of a tree: limbs are drawn many times for each candidate of the trunk, and only their sum is kept.

The trunk is the root and all nodes that branch; the other nodes form chains, the limbs. Given the trunk x, the limbs are independent,

$$p(\text{data} \mid x) = \prod_{i \in \text{trunk}} \phi_i(x_i) \prod_l Z_l(x), \qquad
Z_l(x) = \int \prod_{j \in l} \phi_j(x_j)\, \psi(x_{j-1}, x_j)\, dx_j,$$

and a particle filter down each limb gives an unbiased estimate of $Z_l$ and one draw of the limb (Andrieu, Doucet & Holenstein 2010). With L
particles per limb, C candidates stand for $C L^k$ bodies of k limbs. Where beliefs are broad and joints are narrow, message passing fails. Nested
draws still find the body, because a limb is always drawn from its own trunk.

Edges must be normalised densities of the outer node given the inner one, from which one can draw. Edges that close loops are left out.

All limbs are drawn in one loop, one joint at a time. So the terms of an edge and of a node, which take most of the compile time, occur once in the
program. Shorter limbs wait at their ends.
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from bayes_body.base.errors import input_error
from bayes_body.base.inverse_cdf import inverse_cdf
from bayes_body.base.shapes import Flag, Key, Scalar
from bayes_body.density.graph import Graph, Term
from bayes_body.density.tempering import LogTerms
from bayes_body.kernels.batching import over_particles

# Candidates that a core computes at once: a limb's particles fill its cache.
CANDIDATES = 4


class Edge(NamedTuple):
    """An edge of the tree: its term and row, its outer node, and whether that is the first node of the row."""

    term: int
    row: int
    parent: int
    child: int
    reverse: bool


class Tree(NamedTuple):
    """The tree of a graph.

    Attributes:
        root: the root.
        trunk: edges to the nodes that branch, parents first.
        limbs: edges of each limb, from the trunk outwards; the longest limb is first.
    """

    root: int
    trunk: tuple[Edge, ...]
    limbs: tuple[tuple[Edge, ...], ...]

    @property
    def inner(self) -> tuple[int, ...]:
        """The nodes of the trunk, parents first."""
        return (self.root, *(edge.child for edge in self.trunk))


class Trunks(NamedTuple):
    """Draws of the trunk.

    Attributes:
        values: values of the trunk's nodes, in the order of `Tree.inner`.
        terms: the log of the factors of these nodes: of the likelihood, and of all others with the weight of the draw.
    """

    values: Float[Array, "candidate inner *entry"]
    terms: LogTerms


class Nested(NamedTuple):
    """Draws of all nodes, one for each candidate.

    Attributes:
        values: the draws: the candidate's first trunk, and one draw of each limb.
        log_estimates: logs of unbiased estimates of the product of the limbs' $Z_l$, for each trunk of a candidate.
    """

    values: Float[Array, "candidate node *entry"]
    log_estimates: Float[Array, "candidate sample"]


def tree_of(graph: Graph, root: int = 0) -> Tree:
    """Return the tree that the graph's forest makes, as seen from a root.

    Raises:
        InputError: the forest is not one tree, or one cannot draw along one of its edges.
    """
    edges, visited = dict[int, Edge](), {root}
    rows = {(number, row): graph.pairs[number].plate.rows[row] for number, row in graph.forest()}
    while True:
        place = next((edge for edge, nodes in rows.items() if len(visited & set(nodes)) == 1), None)
        if place is None:
            break
        first, second = rows.pop(place)
        parent, child = (first, second) if first in visited else (second, first)
        edges[child] = Edge(*place, parent, child, reverse=child == first)
        visited.add(child)
    if len(visited) < graph.count:
        unreached = next(name for node, name in enumerate(graph.names) if node not in visited)
        raise input_error("nested draws", f"no edges lead from '{graph.names[root]}' to '{unreached}'", "one tree", "take message passing")
    for edge in edges.values():
        plate = graph.pairs[edge.term].plate
        if plate.draw is None or plate.log_draw is not None or plate.log_beside is not None:
            nodes = f"the edge between '{graph.names[edge.parent]}' and '{graph.names[edge.child]}'"
            remedy = "take message passing"
            raise input_error("nested draws", f"{nodes} is not a density to draw from", "a density, such as that of a kinematic joint", remedy)
    children = [[edge for edge in edges.values() if edge.parent == node] for node in range(graph.count)]
    trunk = [edge for edge in edges.values() if len(children[edge.child]) > 1]
    inner = {root, *(edge.child for edge in trunk)}
    limbs = []
    for edge in edges.values():
        if edge.parent in inner and edge.child not in inner:
            limb = [edge]
            while children[limb[-1].child]:
                limb.append(children[limb[-1].child][0])
            limbs.append(tuple(limb))
    return Tree(root, tuple(trunk), tuple(sorted(limbs, key=len, reverse=True)))


def trunk_draws(key: Key, graph: Graph, tree: Tree, roots: Float[Array, "candidate *entry"]) -> Trunks:
    """Return a trunk for each root, drawn along the edges."""

    def draw(noise_and_root: tuple[_Noise, Array], graph: Graph) -> Trunks:
        noise, root = noise_and_root
        values, log_weight = {tree.root: root}, jnp.zeros((), root.dtype)
        for number, edge in enumerate(tree.trunk):
            term = graph.pairs[edge.term]
            parameters = jax.tree.map(lambda leaf, row=edge.row: leaf[row], term.plate.parameters)
            values[edge.child], weight = _draw(term, noise.select(number), parameters, values[edge.parent], edge.reverse)
            log_weight += weight
        inner = jnp.stack([values[node] for node in tree.inner])
        terms = _unary(graph, _unary_rows(graph, np.array(tree.inner)), inner[:, None])
        return Trunks(inner, LogTerms(jnp.sum(terms.likelihood), jnp.sum(terms.potential) + log_weight))

    noise = _noise(key, graph, tree.trunk, (len(roots), len(tree.trunk)), roots.dtype)
    return over_particles(draw, (noise, roots), graph, checked=False)


def nested_draws(
    key: Key, graph: Graph, tree: Tree, trunks: Float[Array, "candidate sample inner *entry"], power: float | Scalar = 1.0, shared: Flag | bool = True
) -> Nested:
    """Draw the limbs of every candidate: as many particles of a limb as the candidate has trunks.

    Args:
        key: random key.
        graph: the graph. Its prior and proposals are not read.
        tree: its tree.
        trunks: values of the trunk's nodes.
        power: the power of the likelihood.
        shared: whether all trunks of a candidate are the same, so that their limbs are particles of one filter. Otherwise each trunk has one draw of
            each limb, and the estimates are positive but not normalised. They may be used to choose trunks, if they are divided out later.
    """

    def draw(random_and_trunks: tuple[_Noise, Array, Array], arguments: tuple[Graph, Scalar, Flag]) -> Nested:
        return _limbs(*random_and_trunks, *arguments, tree)

    noise_key, uniform_key = jax.random.split(key)
    candidates, samples, longest, limbs = *trunks.shape[:2], len(tree.limbs[0]), len(tree.limbs)
    edges = [edge for limb in tree.limbs for edge in limb]
    noise = _noise(noise_key, graph, edges, (candidates, longest, limbs, samples), trunks.dtype)
    uniform = jax.random.uniform(uniform_key, (candidates, longest + 1, limbs), trunks.dtype)
    arguments = graph, jnp.asarray(power, trunks.dtype), jnp.asarray(shared)
    return over_particles(draw, (noise, uniform, trunks), arguments, CANDIDATES, checked=False)


class _Noise(NamedTuple):
    """The randomness of draws along edges: standard normal numbers for weighted draws, and keys for others, if there are any."""

    normals: Float[Array, "*draw number"]
    keys: Array | None

    def select(self, index: Any) -> "_Noise":
        return jax.tree.map(lambda leaf: leaf[index], self)


def _noise(key: Key, graph: Graph, edges: Sequence[Edge], shape: tuple[int, ...], dtype: Any) -> _Noise:
    """Return the randomness of `shape` draws, made at once: each occurrence of a random generator is much code."""
    # Without the barrier, XLA repeats the draw wherever a part of it is read.
    normals = jax.lax.optimization_barrier(jax.random.normal(key, (*shape, graph.space.dimension + 1), dtype))
    is_weighted = all(graph.pairs[edge.term].plate.weighted_draw is not None for edge in edges)
    return _Noise(normals, None if is_weighted else jax.random.split(key, shape))


class _Depth(NamedTuple):
    """The edges and nodes at one joint of all limbs, or with a leading axis at all joints: a pytree of arrays.

    Attributes:
        edges: for each kind of edge its rows, and which limbs have it.
        unaries: for each term of one node its rows, and which limbs' nodes have it.
        goes_on: for each limb, whether it has this joint.
    """

    edges: tuple[tuple[Int[np.ndarray, " limb"], Bool[np.ndarray, " limb"]], ...]
    unaries: tuple[tuple[Int[np.ndarray, " limb"], Bool[np.ndarray, " limb"]], ...]
    goes_on: Bool[np.ndarray, " limb"]


def _limbs(
    noise: _Noise,
    uniform: Float[Array, "depth limb"],
    trunks: Float[Array, "sample inner *entry"],
    graph: Graph,
    power: Scalar,
    shared: Flag,
    tree: Tree,
) -> Nested:
    """Return a draw of all nodes, and the log-estimates; without a candidate axis."""
    kinds, depths, nodes = _layout(graph, tree)
    count, longest = len(trunks), len(nodes)
    parents = np.array([tree.inner.index(limb[0].parent) for limb in tree.limbs])
    start = jnp.swapaxes(trunks[:, parents], 0, 1)

    def down(carry: tuple[Array, Array, Array], step: tuple[_Noise, Array, _Depth]) -> tuple[tuple[Array, Array, Array], tuple[Array, Array]]:
        (points, log_weights, total), (noise, uniform, depth) = carry, step
        goes_on = depth.goes_on[:, None]
        # Resample
        chosen = jnp.where(goes_on & shared, jax.vmap(_systematic)(uniform, log_weights), jnp.arange(count))
        parents = jax.vmap(lambda values, index: values[index])(points, chosen)
        # Propagate
        drawn, log_draws = _draw_outer(graph, kinds, depth, noise, parents)
        # Reweight
        terms = _unary(graph, depth.unaries, drawn)
        weighted = power * terms.likelihood + terms.potential + jnp.where(shared, log_draws, 0.0)
        weighted = jnp.where(jnp.isnan(weighted), -jnp.inf, weighted)
        estimates = jnp.where(shared, jax.nn.logsumexp(weighted, axis=1, keepdims=True) - jnp.log(count), weighted)
        total += jnp.sum(jnp.where(goes_on, estimates, 0.0), axis=0)
        mask_of_depth = goes_on.reshape(-1, *[1] * (points.ndim - 1))
        points = jnp.where(mask_of_depth, drawn, points)
        return (points, jnp.where(goes_on, weighted, log_weights), total), (points, chosen)

    first = start, jnp.zeros(start.shape[:2], trunks.dtype), jnp.zeros(count, trunks.dtype)
    (_, log_weights, total), (paths, chosen) = jax.lax.scan(down, first, (noise, uniform[:-1], depths))
    index = jax.vmap(_draw_index)(uniform[-1], log_weights)
    path = []
    for depth in reversed(range(longest)):
        path.insert(0, jax.vmap(lambda values, place: values[place])(paths[depth], index))
        index = jax.vmap(lambda values, place: values[place])(chosen[depth], index)
    # Nodes of the trunk, then of the limbs, in the order of the graph.
    drawn = jnp.concatenate([trunks[0], *path])
    order = np.concatenate([tree.inner, nodes.ravel()])
    values = drawn[np.array([np.flatnonzero(order == node)[0] for node in range(graph.count)])]
    return Nested(values, total)


def _layout(graph: Graph, tree: Tree) -> tuple[list[tuple[int, bool]], _Depth, Int[np.ndarray, "depth limb"]]:
    """Return the kinds of edges (term, reverse), the edges and nodes at each depth, and the nodes of the limbs, -1 after the end of a limb."""
    longest = len(tree.limbs[0])
    edges = [[limb[depth] if depth < len(limb) else None for limb in tree.limbs] for depth in range(longest)]
    kinds = sorted({(edge.term, edge.reverse) for limb in tree.limbs for edge in limb})

    def table(row_of: Callable[[Edge], int], has: Callable[[Edge], bool]) -> tuple[np.ndarray, np.ndarray]:
        mask = np.array([[edge is not None and has(edge) for edge in level] for level in edges])
        rows = np.array([[row_of(edge) if edge is not None and has(edge) else 0 for edge in level] for level in edges], np.int32)
        return rows, mask

    by_kind = tuple(table(lambda edge: edge.row, lambda edge, kind=kind: (edge.term, edge.reverse) == kind) for kind in kinds)
    nodes = np.array([[-1 if edge is None else edge.child for edge in level] for level in edges])
    return kinds, _Depth(by_kind, _unary_rows(graph, nodes), nodes >= 0), nodes


def _unary_rows(graph: Graph, nodes: Int[np.ndarray, "*place"]) -> tuple[tuple[np.ndarray, np.ndarray], ...]:
    """Return for each term of one node the rows that read these nodes, and whether there are any."""
    tables = []
    for term in graph.unaries:
        rows = {row_nodes[0]: row for row, row_nodes in enumerate(term.plate.rows)}
        tables.append((np.vectorize(lambda node, rows=rows: rows.get(node, 0), otypes=[np.int32])(nodes), np.isin(nodes, list(rows))))
    return tuple(tables)


def _draw(term: Term, noise: _Noise, parameters: Any, inner: Array, reverse: bool) -> tuple[Array, Scalar]:
    """Return a draw along an edge of a term, with its log-weight."""
    if term.plate.weighted_draw is not None:
        return term.plate.weighted_draw(noise.normals, parameters, inner, reverse)
    assert term.plate.draw is not None and noise.keys is not None
    return term.plate.draw(noise.keys, parameters, inner, reverse), jnp.zeros((), inner.dtype)


def _draw_outer(
    graph: Graph, kinds: Sequence[tuple[int, bool]], depth: _Depth, noise: _Noise, inner: Float[Array, "limb sample *entry"]
) -> tuple[Array, Float[Array, "limb sample"]]:
    """Return draws of the outer nodes given the inner ones, and their log-weights."""
    drawn, log_weights = inner, jnp.zeros(inner.shape[:2], inner.dtype)
    for (number, reverse), (rows, is_kind) in zip(kinds, depth.edges, strict=True):
        term = graph.pairs[number]
        parameters = jax.tree.map(lambda leaf, rows=rows: leaf[rows], term.plate.parameters)

        def draw(noise: _Noise, parameters: Any, value: Array, term: Term = term, reverse: bool = reverse) -> tuple[Array, Scalar]:
            return _draw(term, noise, parameters, value, reverse)

        values, weights = jax.vmap(jax.vmap(draw, (0, None, 0)))(noise, parameters, inner)
        drawn = jnp.where(is_kind.reshape(-1, *[1] * (inner.ndim - 1)), values, drawn)
        log_weights = jnp.where(is_kind[:, None], weights, log_weights)
    return drawn, log_weights


def _unary(graph: Graph, tables: Sequence[tuple[Any, Any]], values: Float[Array, "place sample *entry"]) -> LogTerms:
    """Return the logs of the factors of one node at values of some nodes, (place, sample): of the likelihood, and of all others."""
    likelihood = potential = jnp.zeros(values.shape[:2], values.dtype)
    for term, (rows, has) in zip(graph.unaries, tables, strict=True):
        parameters = jax.tree.map(lambda leaf, rows=rows: leaf[rows], term.plate.parameters)
        logs = jnp.where(has[:, None], jax.vmap(jax.vmap(term.log_potential, (None, 0)))(parameters, values), 0.0)
        likelihood, potential = (likelihood + logs, potential) if term.tempered else (likelihood, potential + logs)
    return LogTerms(likelihood, potential)


def _systematic(uniform: Scalar, log_weights: Float[Array, " sample"]) -> Int[Array, " sample"]:
    """Return ancestors by systematic resampling. All pairs are compared: that needs no loop."""
    count = len(log_weights)
    return _by_weight(log_weights, (jnp.arange(count) + uniform) / count)


def _draw_index(uniform: Scalar, log_weights: Float[Array, " sample"]) -> Int[Array, ""]:
    return _by_weight(log_weights, uniform[None])[0]


def _by_weight(log_weights: Float[Array, " sample"], levels: Float[Array, " level"]) -> Int[Array, " level"]:
    cumulative = jnp.cumsum(jnp.exp(log_weights - jnp.max(log_weights)))
    return inverse_cdf(cumulative, levels, "compare_all")
