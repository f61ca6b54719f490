r"""Nested draws of a tree: limbs are drawn many times for each candidate of the trunk, and only their sum is kept.

The trunk is the root and all nodes that branch; what is left are chains, the limbs. Given the trunk x, the limbs are independent,

$$p(\text{data} \mid x) = \prod_{i \in \text{trunk}} \phi_i(x_i) \prod_l Z_l(x), \qquad
Z_l(x) = \int \prod_{j \in l} \phi_j(x_j)\, \psi(x_{j-1}, x_j)\, dx_j,$$

and a particle filter down each limb gives an unbiased estimate of $Z_l$ and one draw of the limb (Andrieu, Doucet & Holenstein 2010). With L
particles a limb, C candidates stand for $C L^k$ bodies of k limbs. Where message passing is lost, because beliefs are broad and joints are narrow,
this still finds the body: a limb is always drawn from its own trunk.

Edges must be normalised densities of the outer node given the inner one, from which one can draw. Edges that close loops are left out.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from bayes_body.density.graph import Graph
from bayes_body.errors import input_error
from bayes_body.kernels.parts.batching import over_particles
from bayes_body.kernels.parts.resampling import resampler
from bayes_body.shapes import Key, Scalar

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


class Nested(NamedTuple):
    """Draws of all nodes, one for each candidate.

    Attributes:
        values: the draws: the candidate's trunk, and a limb each.
        log_estimates: log of the unbiased estimates of p(data | trunk).
    """

    values: Float[Array, "candidate node *entry"]
    log_estimates: Float[Array, " candidate"]


def tree_of(graph: Graph, root: int = 0) -> Tree:
    """Return the tree that the graph's forest makes, as seen from a root.

    Raises:
        InputError: the forest is not one tree, or one cannot draw along one of its edges.
    """
    edges, known = dict[int, Edge](), {root}
    rows = {(number, row): graph.pairs[number].plate.rows[row] for number, row in graph.forest()}
    while True:
        found = next((edge for edge, nodes in rows.items() if len(known & set(nodes)) == 1), None)
        if found is None:
            break
        first, second = rows.pop(found)
        parent, child = (first, second) if first in known else (second, first)
        edges[child] = Edge(*found, parent, child, reverse=child == first)
        known.add(child)
    if len(known) < graph.count:
        alone = next(name for node, name in enumerate(graph.names) if node not in known)
        raise input_error("nested draws", f"no edges lead from '{graph.names[root]}' to '{alone}'", "one tree", "take message passing")
    for edge in edges.values():
        plate = graph.pairs[edge.term].plate
        if plate.draw is None or plate.log_draw is not None:
            found_no = f"the edge between '{graph.names[edge.parent]}' and '{graph.names[edge.child]}' is not a density to draw from"
            raise input_error("nested draws", found_no, "a density, such as that of a kinematic joint", "take message passing")
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


def trunk_draws(key: Key, graph: Graph, tree: Tree, roots: Float[Array, "candidate *entry"]) -> Float[Array, "candidate node *entry"]:
    """Return values of all nodes whose trunk is drawn given the root; the other nodes are copies of the root."""

    def one(key_and_root: tuple[Key, Array], graph: Graph) -> Array:
        key, root = key_and_root
        values = jnp.broadcast_to(root, (graph.count, *root.shape))
        for number, edge in enumerate(tree.trunk):
            drawn = _along(graph, [edge], jax.random.fold_in(key, number)[None], values[edge.parent][None])
            values = values.at[edge.child].set(drawn[0])
        return values

    return over_particles(one, (jax.random.split(key, len(roots)), roots), graph, checked=False)


def nested_draws(
    key: Key, graph: Graph, tree: Tree, candidates: Float[Array, "candidate node *entry"], samples: int, power: float | Scalar = 1.0
) -> Nested:
    """Draw the limbs of every candidate.

    Args:
        key: random key.
        graph: the graph. Its prior and proposals are not read.
        tree: its tree.
        candidates: values of all nodes; only those of the trunk are read.
        samples: number of particles of a limb.
        power: that of the likelihood.
    """

    def one(key_and_values: tuple[Key, Array], shared: tuple[Graph, Scalar]) -> Nested:
        return Nested(*_limbs(*key_and_values, *shared, tree, samples))

    keys = jax.random.split(key, len(candidates))
    return over_particles(one, (keys, candidates), (graph, jnp.asarray(power, candidates.dtype)), CANDIDATES, checked=False)


def _limbs(key: Key, values: Float[Array, "node *entry"], graph: Graph, power: Scalar, tree: Tree, samples: int) -> tuple[Array, Scalar]:
    """Return the values with new limbs, and the log of the estimate."""
    resample = resampler("systematic")
    inner = [tree.root, *(edge.child for edge in tree.trunk)]
    total = sum((_unary(graph, [node], values[node][None, None], power)[0, 0] for node in inner), jnp.zeros((), values.dtype))
    points = jnp.stack([jnp.broadcast_to(values[limb[0].parent], (samples, *values.shape[1:])) for limb in tree.limbs])
    weights = jnp.zeros(points.shape[:2], values.dtype)
    # What the particles of each limb have been, from the trunk outwards.
    paths = jnp.zeros((*points.shape[:2], len(tree.limbs[0]), *values.shape[1:]), values.dtype)
    for depth in range(len(tree.limbs[0])):
        edges = [limb[depth] for limb in tree.limbs if depth < len(limb)]
        draw_key, pick_key, key = jax.random.split(key, 3)
        some = slice(0, len(edges))
        if depth:
            chosen = jax.vmap(resample)(jax.random.split(pick_key, len(edges)), weights[some])
            points = points.at[some].set(jax.vmap(lambda own, index: own[index])(points[some], chosen))
            paths = paths.at[some].set(jax.vmap(lambda own, index: own[index])(paths[some], chosen))
        drawn = _along(graph, edges, jax.random.split(draw_key, (len(edges), samples)), points[some])
        own = _unary(graph, [edge.child for edge in edges], drawn, power)
        points, weights, paths = points.at[some].set(drawn), weights.at[some].set(own), paths.at[some, :, depth].set(drawn)
        total += jnp.sum(jax.nn.logsumexp(own, axis=1) - jnp.log(samples))
    last = jax.vmap(lambda key, own: jax.random.categorical(key, own))(jax.random.split(key, len(tree.limbs)), weights)
    for number, limb in enumerate(tree.limbs):
        nodes = np.array([edge.child for edge in limb])
        values = values.at[nodes].set(paths[number, last[number], : len(limb)])
    return values, jnp.where(jnp.isnan(total), -jnp.inf, total)


def _along(graph: Graph, edges: Sequence[Edge], keys: Array, known: Float[Array, "edge *sample_entry"]) -> Array:
    """Return a draw of the outer node for each known value of the inner one; edges of one term and direction are drawn at once."""
    found: list[Any] = [None] * len(edges)
    for number, reverse in sorted({(edge.term, edge.reverse) for edge in edges}):
        own = [place for place, edge in enumerate(edges) if (edge.term, edge.reverse) == (number, reverse)]
        plate, rows = graph.pairs[number].plate, np.array([edges[place].row for place in own])
        assert plate.draw is not None

        def draw(key: Key, parameters: Any, value: Array, draw: Any = plate.draw, reverse: bool = reverse) -> Array:
            return draw(key, parameters, value, reverse)

        each = jax.vmap(draw, (0, None, 0)) if keys.ndim > 1 else draw
        drawn = jax.vmap(each)(keys[np.array(own)], jax.tree.map(lambda leaf, rows=rows: leaf[rows], plate.parameters), known[np.array(own)])
        for place, values in zip(own, drawn, strict=True):
            found[place] = values
    return jnp.stack(found)


def _unary(graph: Graph, nodes: Sequence[int], values: Float[Array, "own sample *entry"], power: Scalar) -> Float[Array, "own sample"]:
    """Return the log of the factors of one node at values of some nodes; the likelihood's with its power."""
    total = jnp.zeros(values.shape[:2], values.dtype)
    for term in graph.unaries:
        rows = {nodes_of[0]: row for row, nodes_of in enumerate(term.plate.rows)}
        own = np.array([place for place, node in enumerate(nodes) if node in rows], int)
        if len(own):
            parameters = jax.tree.map(lambda leaf, at=np.array([rows[nodes[place]] for place in own]): leaf[at], term.plate.parameters)
            found = jax.vmap(jax.vmap(term.log_potential, (None, 0)))(parameters, values[own])
            total = total.at[own].add(power * found if term.tempered else found)
    return jnp.where(jnp.isnan(total), -jnp.inf, total)
