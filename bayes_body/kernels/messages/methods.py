"""Methods of particle belief propagation: what they add to the common proposal of a node.

A method gives every node a distribution near its last belief, with a density that is known exactly. In the method `mixture`, it is one part of the
node's proposal, besides messages, prior and detections (kernels/messages/node_proposals.py). In `pbp` and `epbp` it is the whole proposal of a node
that has particles, as in the papers; the other parts only give the first particles. `pampas` draws its particles in strata
(kernels/messages/pampas.py), and uses the common proposal for the joint draws alone.
"""

from typing import Any, Literal, Protocol

from jaxtyping import Array, Float

from bayes_body.base.shapes import Scalar
from bayes_body.density.graph import Graph
from bayes_body.density.tangent_normal import TangentNormal
from bayes_body.kernels.messages.epbp import ExpectationPropagation
from bayes_body.kernels.messages.messages import Beliefs, NodeValues
from bayes_body.kernels.messages.pbp import BeliefKernels

type MethodName = Literal["mixture", "pbp", "epbp", "pampas"]


class Method(Protocol):
    """A method.

    Attributes:
        alone: whether a node that has particles is drawn from the method's distribution alone.
    """

    alone: bool

    def begin(self, graph: Graph, points: Float[Array, "node sample *entry"]) -> Any:
        """Return what the method remembers from round to round, before the first one; `points` are any points of the nodes' space."""
        ...

    def near_beliefs(
        self, graph: Graph, beliefs: Beliefs, weights: NodeValues, fits: TangentNormal, memory: Any, power: float | Scalar
    ) -> tuple[Any, Any]:
        """Return a distribution near each node's belief, and what the method remembers.

        A distribution has `sample(key)` and `log_prob(x)`; they are stacked over the nodes.

        Args:
            graph: the graph.
            beliefs: particles and messages.
            weights: normalised log-weights of the beliefs.
            fits: normal distributions fitted to the beliefs, stacked over the nodes.
            memory: what the method remembers.
            power: that of the likelihood.
        """
        ...


class NormalFits:
    """The methods `mixture` and `pampas`: the normal fits themselves. They remember nothing."""

    alone = False

    def begin(self, graph: Graph, points: Float[Array, "node sample *entry"]) -> tuple[()]:
        """Return nothing."""
        del graph, points
        return ()

    def near_beliefs(
        self, graph: Graph, beliefs: Beliefs, weights: NodeValues, fits: TangentNormal, memory: Any, power: float | Scalar
    ) -> tuple[TangentNormal, Any]:
        """Return the fits."""
        del graph, beliefs, weights, power
        return fits, memory


def method(name: MethodName, inflation: float, floors: Float[Array, " dimension"]) -> Method:
    """Return a method by its name.

    Args:
        name: its name.
        inflation: factor of the covariance of a proposal.
        floors: smallest standard deviation of each tangent coordinate of a proposal.
    """
    match name:
        case "mixture" | "pampas":
            return NormalFits()
        case "pbp":
            return BeliefKernels()
        case "epbp":
            return ExpectationPropagation(inflation, floors)
