"""Pairwise graphs from plain functions and numpyro distributions, for message passing on models without a body.

For example:

    graph = bb.graph(
        {"sensor": (20, 2)},                                                     # 20 nodes, each a point of the plane
        bb.node_factor("prior", dist.Normal(0.5, 1.0).expand([2]).to_event(1)),  # a factor of every node, which also proposes values
        bb.edge_factor("range", log_range, edges, parameters=ranges, draw=draw_range, log_draw=log_draw_range),
    )
"""

import inspect
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from numpyro.distributions import Distribution

from bayes_body.base.errors import input_error
from bayes_body.base.shapes import Key, Scalar
from bayes_body.density.graph import Graph, Mixture, Term, check_rows
from bayes_body.density.plate import Plate
from bayes_body.density.spaces import Space, numbered

type Node = int | str
# Number of values of each node at which factors are checked.
TRIALS = 8


class Part(NamedTuple):
    """A factor or a proposal of a graph, before its nodes have numbers. Make it with `node_factor`, `edge_factor` or `proposal`."""

    name: str
    rows: Sequence[Sequence[Node]] | None
    plate: Plate | None
    distribution: Callable[[int], Distribution] | None = None


def node_factor(name: str, factor: Distribution | Callable[..., Any], nodes: Sequence[Node] | None = None, parameters: Any = None) -> Part:
    """Return factors of one node.

    Args:
        name: a name for error messages.
        factor: a distribution of a node's value, the same for all nodes, from which values are also proposed; or `value -> log-potential`. With
            `parameters`: `(parameters of a node, value) -> log-potential`, or `parameters of a node -> distribution`.
        nodes: numbers or names of the nodes; by default all.
        parameters: pytree with a leading axis of nodes.
    """
    distribution = _as_maker(factor, parameters)
    if distribution:
        return Part(name, _singletons(nodes), Plate("", (), jax.tree_util.Partial(_log_prob), None), distribution)
    return Part(name, _singletons(nodes), Plate("", (), _log_potential(factor, parameters), parameters))


def edge_factor(
    name: str,
    factor: Distribution | Callable[..., Any],
    edges: Sequence[Sequence[Node]],
    parameters: Any = None,
    draw: Callable[..., Array] | None = None,
    log_draw: Callable[..., Scalar] | None = None,
) -> Part:
    """Return factors of two nodes.

    Args:
        name: a name for error messages.
        factor: a distribution of the difference, second value minus first, the same for all edges; or `(first, second) -> log-potential`. With
            `parameters`: `(parameters of an edge, first, second) -> log-potential`, or `parameters of an edge -> distribution of the difference`.
        edges: pairs of nodes, by number or name.
        parameters: pytree with a leading axis of edges.
        draw: proposes a value along an edge: `(key, parameters of the edge, known, reverse) -> other`. Not needed if the factor is a distribution.
        log_draw: `(parameters of the edge, known, other, reverse) -> scalar`, the normalised log-density of `draw`; by default the factor itself.
    """
    distribution = _as_maker(factor, parameters)
    if distribution:
        plate = Plate("", (), jax.tree_util.Partial(_log_difference), None, jax.tree_util.Partial(_draw_difference))
        return Part(name, edges, plate, distribution)
    offered = draw and jax.tree_util.Partial(draw), log_draw and jax.tree_util.Partial(log_draw)
    return Part(name, edges, Plate("", (), _log_potential(factor, parameters), parameters, *offered))


def proposal(
    name: str, distribution: Distribution | Callable[..., Distribution], nodes: Sequence[Node] | None = None, parameters: Any = None
) -> Part:
    """Return a proposal for some nodes: a distribution that is not a factor, or `parameters of a node -> distribution`."""
    return Part(name, _singletons(nodes), None, _as_maker(distribution, parameters))


def graph(variables: Mapping[str, tuple[int, ...]], *parts: Part, space: Space | None = None) -> Graph:
    """Return a pairwise graph.

    Args:
        variables: for each variable, the number of its entries and the shape of one: `(entries, *shape)`. Every entry is a node. Nodes are called
            `sensor_0`, `sensor_1` and so on; a variable of one entry keeps its name.
        parts: factors and proposals.
        space: the space of a node's value; by default plain numbers.

    Raises:
        InputError: values of different shapes, an unknown node, an edge from a node to itself, a factor of more than two nodes, a node for which
            nothing proposes a value, or a log-potential that is NaN or not a single number at proposed values.

    Warns:
        UserWarning: the graph falls into pieces that share no edge. They are sampled independently.
    """
    shapes = {shape[1:] for shape in variables.values()}
    if len(shapes) != 1:
        description = ", ".join(f"{name} {shape}" for name, shape in variables.items())
        raise input_error("graph", f"nodes of different shapes: {description}", "one shape for all", "pad the smaller ones, or build two graphs")
    names = tuple(f"{name}_{i}" if shape[0] > 1 else name for name, shape in variables.items() for i in range(shape[0]))
    unaries, pairs, proposals = [], [], []
    for part in parts:
        rows = _numbered(part, names)
        check_rows(part.name, rows, names)
        distributions = part.distribution and part.distribution(len(rows))
        if distributions is not None and len(rows[0]) == 1:
            proposals.append(_mixture(distributions, rows, len(names)))
        if part.plate is not None:
            parameters = part.plate.parameters if distributions is None else distributions
            plate = replace(part.plate, variable="value", rows=rows, parameters=parameters)
            (unaries if len(rows[0]) == 1 else pairs).append(Term(part.name, len(rows[0]) == 1, plate))
    built = Graph("value", names, space or numbered("value", next(iter(shapes))), tuple(unaries), tuple(pairs), proposals=tuple(proposals))
    _check_reached(built)
    _check_values(built)
    _warn_of_pieces(built)
    return built


def _singletons(nodes: Sequence[Node] | None) -> list[list[Node]] | None:
    return None if nodes is None else [[node] for node in nodes]


def _log_potential(factor: Callable[..., Scalar], parameters: Any) -> jax.tree_util.Partial:
    return jax.tree_util.Partial(factor) if parameters is not None else jax.tree_util.Partial(_without_parameters, jax.tree_util.Partial(factor))


def _without_parameters(factor: Callable[..., Array], parameters: None, *values: Array) -> Array:
    del parameters
    return factor(*values)


def _log_prob(distribution: Distribution, value: Array) -> Scalar:
    return jnp.sum(jnp.asarray(distribution.log_prob(value)))


def _log_difference(distribution: Distribution, first: Array, second: Array) -> Scalar:
    return _log_prob(distribution, second - first)


def _draw_difference(key: Key, distribution: Distribution, entry: Array, reverse: bool) -> Array:
    step = jnp.broadcast_to(distribution.sample(key), entry.shape)
    return entry - step if reverse else entry + step


def _as_maker(factor: Any, parameters: Any) -> Callable[[int], Distribution] | None:
    """Return a function from the number of rows to the distributions of the rows, stacked; None if the factor is a log-potential."""
    if isinstance(factor, Distribution):
        if factor.batch_shape:
            problem = f"a distribution with batch shape {factor.batch_shape}"
            raise input_error("graph", problem, "one distribution", "use `to_event`; if rows differ, give a function of a row's parameters")
        return lambda rows: jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (rows, *jnp.shape(leaf))), factor)
    if parameters is not None and len(inspect.signature(factor).parameters) == 1:
        return lambda rows: jax.vmap(factor)(parameters)
    return None


def _numbered(part: Part, names: tuple[str, ...]) -> tuple[tuple[int, ...], ...]:
    if part.rows is None:
        return tuple((number,) for number in range(len(names)))
    for node in (node for row in part.rows for node in row):
        if isinstance(node, str) and node not in names:
            raise input_error(f"factor '{part.name}'", f"reads the node '{node}'", f"one of {', '.join(names[:5])}...", "correct its rows")
    return tuple(tuple(names.index(node) if isinstance(node, str) else int(node) for node in row) for row in part.rows)


def _mixture(distributions: Distribution, rows: Sequence[Sequence[int]], count: int) -> Mixture:
    """Return the proposals of some nodes as a mixture with one component for every node. The component of the other nodes has no weight."""
    row_of = {row[0]: number for number, row in enumerate(rows)}
    index = jnp.asarray([row_of.get(node, 0) for node in range(count)])
    components = jax.tree.map(lambda leaf: leaf[index][:, None], distributions)
    return Mixture(components, jnp.asarray([[0.0 if node in row_of else -jnp.inf] for node in range(count)]))


def _check_reached(built: Graph) -> None:
    """Check that every node has a proposal, or is reached from a node with a proposal along edges that propose."""
    reached = {int(node) for mixture in built.proposals for node in np.flatnonzero(np.asarray(mixture.exists))}
    previous_count = -1
    while len(reached) > previous_count:
        previous_count = len(reached)
        for term in (term for term in built.pairs if term.plate.draw is not None):
            reached |= {node for row in term.plate.rows if set(row) & reached for node in row}
    lost = [name for node, name in enumerate(built.names) if node not in reached]
    if lost:
        remedy = "add a proposal, a distribution as its factor, or an edge with `draw` from a node that has one"
        raise input_error("graph", f"nothing proposes values for the node '{lost[0]}'", "a proposal for every node", remedy)


@jax.jit
def _offered(proposals: tuple[Mixture, ...]) -> Float[Array, "proposal node trial *entry"]:
    """Return values of every node from each of the proposals."""
    return jnp.stack([mixture.sample(jax.random.key(0), TRIALS) for mixture in proposals])


def _check_values(built: Graph) -> None:
    """Check every factor at some values that the proposals offer."""
    offered = np.asarray(_offered(built.proposals))
    first = np.argmax([np.asarray(mixture.exists) for mixture in built.proposals], axis=0)
    values = offered[first, np.arange(built.count)]
    for term in (*built.unaries, *built.pairs):
        nodes = [values[column] for column in np.asarray(term.rows).T]
        of_row = jax.vmap(term.log_potential, in_axes=(None, *[0] * len(nodes)))
        log_potentials = jax.jit(jax.vmap(of_row))(term.plate.parameters, *nodes)
        if log_potentials.shape != (len(term.plate.rows), TRIALS):
            raise input_error(
                f"factor '{term.name}'", f"returns an array of shape {log_potentials.shape[2:]}", "one number", "return the sum of its terms"
            )
        bad = np.flatnonzero(np.isnan(np.asarray(log_potentials)).any(axis=1))
        if len(bad):
            nodes_read = " and ".join(f"'{built.names[node]}'" for node in term.plate.rows[bad[0]])
            remedy = "look for 0 / 0, the logarithm of a negative number, or missing data"
            raise input_error(f"factor '{term.name}'", f"its log-potential at {nodes_read} is NaN", "a number, or minus infinity", remedy)


def _warn_of_pieces(built: Graph) -> None:
    pieces = built.count - len(built.forest())
    if pieces > 1 and built.pairs:
        warnings.warn(f"graph: it falls into {pieces} pieces without an edge between them; they are sampled independently", UserWarning, stacklevel=3)
