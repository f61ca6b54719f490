"""Schedules of message passing as arrays of integers, so that one compiled update serves all of them.

A round redraws the particles of some nodes and evaluates all messages into them. In `flooding`, a round redraws all nodes. In `tree`, a round redraws
the nodes of one depth, from the leaves to the root and back (Sigal et al. 2011: extremities, torso, extremities).
"""

from typing import Literal, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from bayes_body.density.graph import Graph

type Schedule = Literal["flooding", "tree"]


class Round(NamedTuple):
    """One round; in a schedule, every array has a leading axis of rounds. Numbers beyond the last row or node are padding.

    Attributes:
        nodes: the nodes that are redrawn.
        unary: for each term of one node, its rows at these nodes.
        pairs: for each term of two nodes, the rows whose second node is among them, and those whose first is.
        power: the power of the likelihood.
    """

    nodes: Int[Array, "_"]
    unary: tuple[Int[Array, "_"], ...]
    pairs: tuple[tuple[Int[Array, "_"], Int[Array, "_"]], ...]
    power: Float[Array, ""]


def schedule(graph: Graph, kind: Schedule, iterations: int, annealing: float = 1.0) -> Round:
    """Return the rounds of all iterations, stacked.

    Args:
        graph: the graph.
        kind: flooding or tree.
        iterations: number of iterations M.
        annealing: κ: the likelihood's power in iteration m is κ^(M - m), 1 in the last.
    """
    groups = depths(graph) if kind == "tree" else [list(range(graph.count))]
    groups = groups[::-1] + groups[1:]
    widest = max(map(len, groups))
    rounds = [(group, annealing ** (iterations - 1 - iteration)) for iteration in range(iterations) for group in groups]

    def rows(term_rows: np.ndarray, column: int) -> Int[Array, "round some"]:
        row_lists = [np.flatnonzero(np.isin(term_rows[:, column], group)) for group, _ in rounds]
        return _padded(row_lists, max(map(len, row_lists)), len(term_rows))

    return Round(
        nodes=_padded([np.array(group) for group, _ in rounds], widest, graph.count),
        unary=tuple(rows(term.rows, 0) for term in graph.unaries),
        pairs=tuple((rows(term.rows, 1), rows(term.rows, 0)) for term in graph.pairs),
        power=jnp.asarray([power for _, power in rounds], float),
    )


def depths(graph: Graph) -> list[list[int]]:
    """Return the nodes by their distance from the root of their tree in the graph's forest: the root is the node with the most edges."""
    neighbours: list[list[int]] = [[] for _ in range(graph.count)]
    for number, row in graph.forest():
        first, second = graph.pairs[number].plate.rows[row]
        neighbours[first].append(second)
        neighbours[second].append(first)
    depth = [-1] * graph.count
    for start in sorted(range(graph.count), key=lambda node: -len(neighbours[node])):
        level = [start] if depth[start] < 0 else []
        distance = 0
        while level:
            for node in level:
                depth[node] = distance
            level = [neighbour for node in level for neighbour in neighbours[node] if depth[neighbour] < 0]
            distance += 1
    return [[node for node in range(graph.count) if depth[node] == d] for d in range(max(depth) + 1)]


def _padded(lists: list[np.ndarray], length: int, filling: int) -> Int[Array, "round some"]:
    return jnp.asarray(np.stack([np.concatenate([indices, np.full(length - len(indices), filling)]) for indices in lists]), int)
