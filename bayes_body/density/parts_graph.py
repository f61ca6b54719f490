r"""The density of a frame as a graph: the entries of its plated variable are the nodes, and its plates are the edges.

The prediction is a mixture over ancestors of products over nodes, $\sum_a w_a \prod_i p(x_i \mid x^a_{t-1})$. Messages use each node's own mixture,
$\sum_a w_a\, p(x_i \mid x^a_{t-1})$. The joint draws sum over ancestors exactly. Terms of the density that are not plates enter only by the weights
of the joint draws.

Where the sizes of the nodes are not known, they are further variables of the state with a number for each node, and belong to the value of a node
(density/sized_nodes.py).
"""

from dataclasses import dataclass, replace
from functools import partial

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from bayes_body.base.errors import input_error
from bayes_body.base.shapes import Scalar
from bayes_body.density.density import Density, Predictions
from bayes_body.density.graph import Graph, Mixture, Term, check_rows, split
from bayes_body.density.plate import Plate
from bayes_body.density.sized_nodes import size_normals, sized_mixture, sized_plate, sized_space
from bayes_body.density.spaces import Flat, Space
from bayes_body.density.spaces import Plate as PlateSpace
from bayes_body.density.tangent_normal import fit

# Number of draws of the prediction that detections are combined with, and the factor of its covariance: a person who is lost is not where predicted.
PREDICTED, WIDER = 100, 4.0


@partial(jax.tree_util.register_dataclass, meta_fields=["variable", "sizes"], data_fields=["density", "predictions"])
@dataclass(frozen=True)
class Rest:
    """The log of the factors that are not plates, as a function of the nodes' values. `density` has only these factors."""

    variable: str
    sizes: tuple[str, ...]
    density: Density
    predictions: Predictions

    def __call__(self, value: Float[Array, "node *entry"]) -> Scalar:
        """Return the log of these factors. Those that read the previous frame are averaged over the ancestors of the value."""
        density, state = self.density, self.density.transition.with_derived(split(self.variable, self.sizes, value))
        if not density.reads_previous:
            return density.log_weight(state, density.ancestor(0))
        return density.marginal(state, predictions=self.predictions) - replace(density, factors=()).marginal(state, predictions=self.predictions)


def parts_graph(density: Density, user: str = "the kernel 'particle_bp'") -> Graph:
    """Return the graph of a frame's density.

    Args:
        density: the density.
        user: who needs the graph, for error messages.

    Raises:
        InputError: the state is not one plated variable, the prediction does not say how each entry moves, or a factor reads more than two entries.
    """
    first = density.ancestor(0)
    conditional = density.transition.conditional(first)
    remedy = 'give the body the placement "parts": [body] placement = "parts"'
    spaces = {name: density.transition.space(name, first[name].shape) for name in conditional}
    name, space = next(iter(spaces.items()))
    sizes = tuple(spaces)[1:]
    if not isinstance(space, PlateSpace) or not all(_is_size(spaces[size], space) for size in sizes):
        raise input_error(user, f"the state is {', '.join(conditional)}", "one variable of several entries, such as the parts of a body", remedy)
    if not hasattr(conditional[name], "entries"):
        problem = f"the distribution of '{name}' does not say how each entry moves"
        raise input_error(f"dynamics '{density.transition.name}'", problem, "a method `entries()`", "take rigid_walk")
    predictions = density.predictions()
    log_weights = density.previous.log_weights
    normals = size_normals([predictions[size] for size in sizes], log_weights) if sizes else None
    unaries, pairs, joint_factors = [], [], []
    for factor in density.factors:
        plate = factor.log_potential
        if not isinstance(plate, Plate):
            joint_factors.append(factor)
            continue
        check_rows(factor.name, plate.rows, space.names)
        plate = plate if normals is None else sized_plate(plate, sizes, normals)
        term = Term(factor.name, factor.side == "likelihood", plate, density.data.get(factor.name))
        (unaries if len(plate.rows[0]) == 1 else pairs).append(term)
    prior = _by_node(predictions[name], log_weights)
    proposals = _with_prediction(space.space, prior, density.proposals) if density.proposals else ()
    if normals is not None:
        prior, proposals = sized_mixture(prior, normals), tuple(sized_mixture(mixture, normals) for mixture in proposals)
    rest = replace(density, factors=tuple(joint_factors))
    return Graph(
        variable=name,
        names=space.names,
        space=sized_space(space.space, sizes) if sizes else space.space,
        unaries=tuple(unaries),
        pairs=tuple(pairs),
        prior=prior,
        proposals=proposals,
        joint_factors=Rest(name, sizes, rest, {name: predictions[name]}) if joint_factors else None,
        sizes=sizes,
    )


def _with_prediction(space: Space, prior: Mixture, detections: tuple[Mixture, ...]) -> tuple[Mixture, ...]:
    """Return detections combined with a wide normal prediction of their nodes: nobody detects how a limb is turned about its axis."""
    # Any draws will do: where to look is no term of the density.
    points = prior.sample(jax.random.key(0), PREDICTED)
    equal = jnp.full(PREDICTED, 1 / PREDICTED, points.dtype)
    predictions = jax.vmap(lambda drawn: fit(space, equal, drawn, WIDER))(points)
    return tuple(mixture.combine(predictions) for mixture in detections)


def _is_size(space: Space, nodes: PlateSpace) -> bool:
    """Whether a variable has one number for each node."""
    return isinstance(space, Flat) and space.labels == nodes.names


def _by_node(predictions: object, log_weights: Float[Array, " particle"]) -> Mixture:
    """Return for every node the mixture of its predictions from all ancestors."""
    entries = jax.vmap(lambda prediction: prediction.entries())(predictions)
    turned = jax.tree.map(lambda leaf: jnp.swapaxes(leaf, 0, 1), entries)
    nodes = jax.tree.leaves(turned)[0].shape[0]
    return Mixture(turned, jnp.broadcast_to(log_weights, (nodes, *log_weights.shape)))
