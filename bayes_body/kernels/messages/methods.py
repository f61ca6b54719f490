r"""Methods of particle belief propagation: what each adds to the common proposal of a node.

A method gives every node a distribution near its last belief, with a density that is known exactly. In the method `mixture`, it is one part of the
node's proposal, besides messages, prior and detections (kernels/messages/node_proposals.py). In `pbp` and `epbp` it is the whole proposal of a node
that has particles, as in the papers; the other parts only give the first particles. `pampas` draws its particles in strata
(kernels/messages/pampas.py), and uses the common proposal for the joint draws alone.

The method `pbp` (Ihler & McAllester 2009) draws the particles of a node from an estimate of its belief. The paper runs Markov chains whose target is
the belief. Their draws are dependent, and have a density that is known only up to a constant. Here the estimate is a kernel density estimate of the
last belief's particles,

$$q_i(x) = \sum_n w_n\, \mathcal N\big(x;\, x_i^{(n)}, h^2 \Sigma_i\big), \qquad h = \Big(\frac{4}{(D + 2)\, \text{ESS}}\Big)^{1 / (D + 4)},$$

with normal kernels in the tangent spaces at the particles (`density.tangent_normal`), the covariance $\Sigma_i$ of the normal fit to the belief, and
Silverman's bandwidth for D coordinates. It is evaluated exactly, so the draws are independent and the evidence is unbiased. Nothing is proposed
outside the last belief, so the method finds no place that its first particles missed.
"""

from dataclasses import dataclass
from functools import partial
from typing import Any, Literal, Protocol

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from bayes_body.base.inverse_cdf import inverse_cdf
from bayes_body.base.shapes import Key, Scalar
from bayes_body.density.graph import Graph
from bayes_body.density.tangent_normal import TangentNormal
from bayes_body.kernels.messages.epbp import ExpectationPropagation
from bayes_body.kernels.messages.messages import Beliefs, NodeValues
from bayes_body.kernels.weights import effective_sample_size


@partial(jax.tree_util.register_dataclass, meta_fields=[], data_fields=["kernel", "points", "log_weights"])
@dataclass(frozen=True)
class KernelEstimate:
    """A kernel density estimate.

    Attributes:
        kernel: the kernel, around any point.
        points: the particles.
        log_weights: their normalised log-weights.
    """

    kernel: TangentNormal
    points: Float[Array, "sample *entry"]
    log_weights: Float[Array, " sample"]

    def sample(self, key: Key) -> Array:
        """Draw a point."""
        choice, draw = jax.random.split(key)
        cumulative = jnp.cumsum(jnp.exp(self.log_weights))
        index = inverse_cdf(cumulative, jax.random.uniform(choice))
        return self._component(self.points[index]).sample(draw)

    def log_prob(self, x: Array) -> Scalar:
        """Return the log-density at a point."""
        return jax.nn.logsumexp(jax.vmap(lambda point: self._component(point).log_prob(x))(self.points) + self.log_weights)

    def _component(self, point: Array) -> TangentNormal:
        return TangentNormal(self.kernel.space, point, self.kernel.root, self.kernel.inverse)


class BeliefKernels:
    """The method `pbp`. It remembers nothing."""

    is_sole_proposal = True

    def begin(self, graph: Graph, points: Float[Array, "node sample *entry"]) -> tuple[()]:
        """Return nothing."""
        del graph, points
        return ()

    def near_beliefs(
        self, graph: Graph, beliefs: Beliefs, weights: NodeValues, fits: TangentNormal, memory: Any, power: float | Scalar
    ) -> tuple[KernelEstimate, Any]:
        """Return the kernel density estimates of all beliefs, stacked over the nodes."""
        del power
        dimension = graph.space.dimension
        width = (4 / (dimension + 2) / jax.vmap(effective_sample_size)(weights)) ** (1 / (dimension + 4))
        kernel = TangentNormal(fits.space, fits.mean, width[:, None, None] * fits.root, fits.inverse / width[:, None, None])
        return KernelEstimate(kernel, beliefs.points, weights), memory


type MethodName = Literal["mixture", "pbp", "epbp", "pampas"]


class Method(Protocol):
    """A method of particle belief propagation.

    Attributes:
        is_sole_proposal: whether a node that has particles is drawn from the method's distribution alone.
    """

    is_sole_proposal: bool

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
            power: the power of the likelihood.
        """
        ...


class NormalFits:
    """The methods `mixture` and `pampas`: the normal fits themselves. They remember nothing."""

    is_sole_proposal = False

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
