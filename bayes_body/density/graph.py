r"""A pairwise graph: nodes are the entries of one plated variable, such as the parts of a body; factors read one node or two.

$$\log p(x_1 \ldots x_V) = \sum_i \log \phi_i(x_i) + \sum_{(i, j)} \log \psi_{ij}(x_i, x_j) + \log \sum_a w_a \prod_i \pi_{ia}(x_i).$$

The last term is optional: a prior that is a mixture over ancestors a of products over nodes. Message passing reads the graph. It does not depend on
bodies: `graph` makes a graph from plain functions and distributions, and density/parts_graph.py makes one from the density of a frame. Proposals of
nodes, such as detections, are not terms of the density. They only say where to look.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from bayes_body.base.errors import input_error
from bayes_body.base.shapes import Key, Scalar
from bayes_body.density.plate import Plate
from bayes_body.density.spaces import Space
from bayes_body.density.tangent_normal import TangentNormal


@partial(jax.tree_util.register_dataclass, meta_fields=["name", "tempered"], data_fields=["plate", "data"])
@dataclass(frozen=True)
class Term:
    """Factors of the same form. Each reads one row, of one node or of two.

    Attributes:
        name: their name in error messages.
        tempered: whether they are likelihoods, which annealing tempers.
        plate: the factors.
        data: the frame's data that they read, or None.
    """

    name: str
    tempered: bool
    plate: Plate
    data: Any = None

    @property
    def rows(self) -> Int[np.ndarray, "row arity"]:
        """The nodes that each factor reads."""
        return np.array(self.plate.rows, np.int32)

    def log_potential(self, parameters: Any, *entries: Array) -> Array:
        """Return the log-potential of one row, given its parameters."""
        return self.plate.log_potential(parameters, *entries, **({} if self.data is None else {"data": self.data}))

    def pairwise(self, parameters: Any, first: Array, second: Array) -> Float[Array, "first second"]:
        """Return the log-potential of one row of two for all pairs of values of its nodes."""
        if self.plate.pairwise is not None:
            return self.plate.pairwise(parameters, first, second)
        return jax.vmap(lambda x: jax.vmap(lambda y: self.log_potential(parameters, x, y))(second))(first)


class Mixture(NamedTuple):
    """For every node, a mixture of distributions of its value.

    Attributes:
        components: a distribution with leading axes (node, component): a pytree with `sample(key)` and `log_prob(value)` for one of them.
        log_weights: normalised for every node. A node without a proposal has -inf everywhere.
    """

    components: Any
    log_weights: Float[Array, "node component"]

    @property
    def exists(self) -> Array:
        """For every node, whether it has a proposal."""
        return jnp.max(self.log_weights, axis=1) > -jnp.inf

    def sample(self, key: Key, count: int) -> Float[Array, "node draw *entry"]:
        """Draw `count` values of every node."""
        choice, draw = jax.random.split(key)
        nodes = self.log_weights.shape[0]
        index = jax.random.categorical(choice, self.log_weights[:, None], axis=-1, shape=(nodes, count))
        chosen = jax.tree.map(lambda leaf: jax.vmap(lambda row, i: row[i])(leaf, index), self.components)
        return jax.vmap(jax.vmap(lambda key, component: jnp.asarray(component.sample(key))))(jax.random.split(draw, (nodes, count)), chosen)

    def combine(self, predictions: TangentNormal) -> "Mixture":
        """Return the mixtures times normal predictions, stacked over the nodes. A component that fits its node's prediction gains weight.

        The components have `combine(prediction) -> (TangentNormal, log of the integral)`.
        """
        components, fits = jax.vmap(lambda row, prediction: jax.vmap(lambda one: one.combine(prediction))(row))(self.components, predictions)
        log_weights = self.log_weights + jnp.where(self.log_weights > -jnp.inf, fits, 0.0)
        total = jax.nn.logsumexp(log_weights, axis=1, keepdims=True)
        return Mixture(components, jnp.where(total > -jnp.inf, log_weights - total, -jnp.inf))

    def log_components(self, values: Float[Array, "node draw *entry"]) -> Float[Array, "node draw component"]:
        """Return the log-density of each component, without its weight, at the values of every node.

        Components may offer `log_prob_of_pairs(values) -> (value, component)`, which is faster than one by one.
        """

        def one_by_one(components: Any, points: Array) -> Array:
            return jax.vmap(lambda x: jax.vmap(lambda component: jnp.asarray(component.log_prob(x)))(components))(points)

        def of_node(components: Any, points: Array) -> Array:
            return components.log_prob_of_pairs(points) if hasattr(components, "log_prob_of_pairs") else one_by_one(components, points)

        return jax.vmap(of_node)(self.components, values)

    def log_prob(self, values: Float[Array, "node draw *entry"]) -> Float[Array, "node draw"]:
        """Return the log-density of the values of every node; -inf for a node without a proposal."""
        weights = self.log_weights[:, None]
        return jax.nn.logsumexp(jnp.where(weights > -jnp.inf, self.log_components(values) + weights, -jnp.inf), axis=-1)


@partial(
    jax.tree_util.register_dataclass,
    meta_fields=["variable", "names", "space", "sizes"],
    data_fields=["unaries", "pairs", "prior", "proposals", "joint_factors"],
)
@dataclass(frozen=True)
class Graph:
    """A pairwise graph.

    Attributes:
        variable: the name of the plated variable.
        names: the names of the nodes.
        space: the space of a node's value.
        unaries: factors of one node.
        pairs: factors of two nodes.
        prior: a mixture over ancestors of products over nodes, or None. All nodes have the same ancestor, so its weights are the same for all.
        proposals: distributions that say where to look for the nodes. They are not factors.
        joint_factors: value of the variable -> log of the factors that read more than two nodes, or None. Only the weights of the joint draws
            contain them.
        sizes: variables with one number for each node. These are the last entries of a node's value.
    """

    variable: str
    names: tuple[str, ...]
    space: Space
    unaries: tuple[Term, ...]
    pairs: tuple[Term, ...]
    prior: Mixture | None = None
    proposals: tuple[Mixture, ...] = ()
    joint_factors: Any = None
    sizes: tuple[str, ...] = ()

    def sampled(self, value: Float[Array, "node *entry"]) -> dict[str, Array]:
        """Return the sampled variables of a state in which the nodes have these values."""
        return split(self.variable, self.sizes, value)

    @property
    def count(self) -> int:
        """The number of nodes."""
        return len(self.names)

    def log_density(self, value: Float[Array, "node *entry"]) -> Scalar:
        """Return the log-density of the values of all nodes, up to a constant."""
        terms = [jnp.sum(term.plate.log_potentials(value, term.data)) for term in (*self.unaries, *self.pairs)]
        of_ancestors = jnp.sum(self.by_ancestor(value[:, None])[:, 0], axis=0)
        return sum(terms, jax.nn.logsumexp(of_ancestors + self.log_ancestors) + self.log_rest(value))

    @property
    def log_ancestors(self) -> Float[Array, " ancestor"]:
        """The log-weights of the ancestors; without a prior there is one ancestor."""
        return jnp.zeros(1) if self.prior is None else self.prior.log_weights[0]

    def by_ancestor(self, values: Float[Array, "node draw *entry"]) -> Float[Array, "node draw ancestor"]:
        """Return the log of the prior given each ancestor, without its weight, at the values of every node; 0 without a prior."""
        return jnp.zeros((*values.shape[:2], 1), values.dtype) if self.prior is None else self.prior.log_components(values)

    def log_rest(self, value: Float[Array, "node *entry"]) -> Scalar:
        """Return the log of the factors that read more than two nodes."""
        return jnp.zeros((), value.dtype) if self.joint_factors is None else self.joint_factors(value)

    @property
    def only_closing(self) -> tuple[bool, ...]:
        """For each term of `pairs`, whether it proposes nothing and all its edges close loops, such as penetration between the parts of a body."""
        joining = {number for number, _ in self.forest()}
        return tuple(term.plate.draw is None and number not in joining for number, term in enumerate(self.pairs))

    def forest(self) -> tuple[tuple[int, int], ...]:
        """Return a maximal set of edges without a loop, as (term, row) of `pairs`. Edges of earlier terms come first."""
        group, edges = list(range(self.count)), []

        def root(node: int) -> int:
            while group[node] != node:
                node = group[node]
            return node

        for number, term in enumerate(self.pairs):
            for row, (first, second) in enumerate(term.plate.rows):
                a, b = root(first), root(second)
                if a != b:
                    group[a] = b
                    edges.append((number, row))
        return tuple(edges)


def split(variable: str, sizes: tuple[str, ...], value: Float[Array, "node *entry"]) -> dict[str, Array]:
    """Return the plated variable and the sizes of the nodes from values whose last entries are the sizes."""
    if not sizes:
        return {variable: value}
    return {variable: value[:, : -len(sizes)], **{name: value[:, number - len(sizes)] for number, name in enumerate(sizes)}}


def check_rows(name: str, rows: Sequence[Sequence[int]], names: Sequence[str]) -> None:
    """Check the rows of a factor.

    Raises:
        InputError: a row has more than two nodes, reads a node twice, or reads one that does not exist.
    """
    for row in rows:
        if not 1 <= len(row) <= 2:
            problem, remedy = f"reads {len(row)} nodes at once", "write it as factors of one node or two"
            raise input_error(f"factor '{name}'", problem, "one node or two", remedy)
        outside = [node for node in row if not 0 <= node < len(names)]
        if outside:
            raise input_error(f"factor '{name}'", f"reads the node {outside[0]}", f"0 to {len(names) - 1}", "correct its rows")
        if len(set(row)) < len(row):
            raise input_error(f"factor '{name}'", f"has an edge from '{names[row[0]]}' to itself", "two nodes", "make it a factor of one node")
