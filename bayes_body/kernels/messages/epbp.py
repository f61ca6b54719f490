r"""Proposals of expectation particle belief propagation (Lienart, Teh & Doucet 2015): normal distributions by expectation propagation.

$$q_u(x) \propto \eta_u(x) \prod_{w \to u} \eta_{wu}(x)$$

with a site $\eta$ for the factors of the node itself and one for each message into it. Sites are unnormalised normal densities in the tangent space
at a reference point of the node, given by a precision $\Lambda$ and a shift $\Lambda m$. A site is updated as in expectation propagation. The cavity
$q_u / \eta_{wu}$ times the message $m_{wu}$ is the tilted distribution. Its mean and covariance come from the node's particles, weighted by the
tilted distribution over the density from which they were drawn. The new site takes the cavity to these moments. The sites of a node are updated one
after the other, on the same particles. So after each of them $q_u$ has the moments of a tilted distribution, and is positive definite. An update is
discarded if its cavity is not positive semi-definite, or if there are fewer effective particles than a covariance has rows, since it is then
singular. The program of the authors also discards sites that are not positive definite themselves. The proposal of a node with several peaks then
stays too narrow.

After the updates the reference point moves to the mean of $q_u$. Sites are carried to the tangent space there by the derivative of the change of
coordinates, which is exact in flat spaces. A proposal's covariance is $q_u$'s times `inflation`, plus the floors of the other methods; the paper's
inflation is 1. The density of the proposal is exact whatever the sites are. They only decide how good it is.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from bayes_body.base.shapes import Scalar
from bayes_body.density.graph import Graph
from bayes_body.density.spaces import Space
from bayes_body.density.tangent_normal import TangentNormal, least_sds, tangent_normal, widened
from bayes_body.kernels.messages.messages import Beliefs, NodeValues, normalised, slots
from bayes_body.kernels.weights import effective_sample_size


class Sites(NamedTuple):
    """The sites of the nodes: their own factors first, then the messages into them. A node has zeros for missing messages.

    Attributes:
        precision: Λ, in the tangent space at the reference point.
        shift: Λ times the mean.
        reference: the reference point of each node.
        begun: whether the reference point has been set.
    """

    precision: Float[Array, "*node site dimension dimension"]
    shift: Float[Array, "*node site dimension"]
    reference: Float[Array, "*entry"]
    begun: Float[Array, "*node"]


class ExpectationPropagation:
    """The method `epbp`. It remembers the sites."""

    is_sole_proposal = True

    def __init__(self, inflation: float, floors: Float[Array, " dimension"]):
        """Take the factor of the proposals' covariance, and their smallest standard deviations."""
        self.inflation, self.floors = inflation, floors

    def begin(self, graph: Graph, points: Float[Array, "node sample *entry"]) -> Sites:
        """Return sites that say nothing."""
        count, dimension, dtype = 1 + _slots(graph).shape[1], graph.space.dimension, points.dtype
        precision = jnp.zeros((graph.count, count, dimension, dimension), dtype)
        return Sites(precision, precision[..., 0], points[:, 0], jnp.zeros(graph.count, dtype))

    def near_beliefs(
        self, graph: Graph, beliefs: Beliefs, weights: NodeValues, fits: TangentNormal, memory: Sites, power: float | Scalar
    ) -> tuple[TangentNormal, Sites]:
        """Return the proposals that the updated sites define, stacked over the nodes; the normal fit where no update was accepted yet."""
        del weights
        unary = beliefs.log_prior + power * beliefs.likelihood
        factors = jnp.concatenate([unary[:, None], _incoming(graph, beliefs)], axis=1)

        def of_node(
            sites: Sites, points: Array, log_q: Array, factors: Float[Array, "site sample"], ready: Array, fitted: TangentNormal
        ) -> tuple[TangentNormal, Sites]:
            reference = jnp.where(sites.begun > 0, sites.reference, fitted.mean)
            v = jnp.asarray(graph.space.local(reference[None], points))
            log_drawn = log_q + jnp.asarray(graph.space.log_measure(v))
            updated = _updated(sites._replace(reference=reference), v, factors, log_drawn, least_sds(v, self.floors))
            proposal, proper = _proposal(graph.space, updated, self.inflation, self.floors)
            moved, accepted = _moved(graph.space, updated, proposal.mean), (ready > 0) & proper
            next_sites = jax.tree.map(lambda new, old: jnp.where(accepted, new, old), moved._replace(begun=jnp.ones_like(sites.begun)), sites)
            return jax.tree.map(lambda proposed, fallback: jnp.where(accepted, proposed, fallback), proposal, fitted), next_sites

        return jax.vmap(of_node)(memory, beliefs.points, beliefs.log_q, factors, beliefs.ready, fits)


def _slots(graph: Graph) -> Int[np.ndarray, "node slot"]:
    """Return the numbers of the messages into each node, in the order of `_incoming`."""
    return slots(np.concatenate([term.rows[:, column] for term in graph.pairs for column in (1, 0)] or [np.zeros(0, int)]), graph.count)


def _incoming(graph: Graph, beliefs: Beliefs) -> Float[Array, "node slot sample"]:
    """Return the log of the messages into each node at its particles; 0 where there is none."""
    messages = [message for directed in beliefs.messages for message in directed]
    return jnp.concatenate([*messages, jnp.zeros_like(beliefs.log_q[:1])])[_slots(graph)]


def _updated(
    sites: Sites,
    v: Float[Array, "sample dimension"],
    factors: Float[Array, "site sample"],
    log_drawn: Float[Array, " sample"],
    least: Float[Array, " dimension"],
) -> Sites:
    """Return the sites of one node after one update of each.

    Args:
        sites: the sites.
        v: tangent vectors of the particles.
        factors: log of each site's factor at the particles.
        log_drawn: log-density of the vectors' proposal.
        least: smallest standard deviations of a tilted distribution.
    """

    def update_site(natural: tuple[Array, Array], number: Array) -> tuple[tuple[Array, Array], None]:
        precision, shift = natural
        # The other sites are summed. A difference from the sum of all would not be exactly zero.
        mask = (jnp.arange(len(shift)) != number).astype(shift.dtype)
        cavity, cavity_shift = jnp.einsum("k,kij->ij", mask, precision), mask @ shift
        log_cavity = v @ cavity_shift - 0.5 * jnp.sum((v @ cavity) * v, axis=1)
        log_weights = normalised(factors[number] + log_cavity - log_drawn)
        weights = jnp.exp(log_weights)
        mean = weights @ v
        covariance = ((v - mean) * weights[:, None]).T @ (v - mean) + jnp.diag(least**2)
        tilted = jnp.linalg.inv(covariance)
        site, site_shift = tilted - cavity, tilted @ mean - cavity_shift
        # A message of zeros everywhere comes from a node without particles.
        said = jnp.any(factors[number] != 0) & (effective_sample_size(log_weights) > len(mean) + 1)
        good = said & (jnp.linalg.eigvalsh(cavity)[0] >= 0)
        return (
            precision.at[number].set(jnp.where(good, 0.5 * (site + site.T), precision[number])),
            shift.at[number].set(jnp.where(good, site_shift, shift[number])),
        ), None

    (precision, shift), _ = jax.lax.scan(update_site, (sites.precision, sites.shift), jnp.arange(factors.shape[0]))
    return sites._replace(precision=precision, shift=shift)


def _proposal(space: Space, sites: Sites, inflation: float, floors: Float[Array, " dimension"]) -> tuple[TangentNormal, Array]:
    """Return the proposal of one node, and whether its sites define one."""
    precision, shift = jnp.sum(sites.precision, axis=0), jnp.sum(sites.shift, axis=0)
    proper = jnp.any(sites.precision != 0)
    covariance = jnp.linalg.inv(jnp.where(proper, precision, jnp.eye(len(shift), dtype=shift.dtype)))
    mean = covariance @ shift
    point = jnp.asarray(space.retract(sites.reference, mean))
    change = _change(space, sites.reference, mean, point)
    turned = change @ covariance @ change.T
    return tangent_normal(space, point, widened(space, inflation * 0.5 * (turned + turned.T), floors)), proper


def _moved(space: Space, sites: Sites, point: Array) -> Sites:
    """Return the sites of one node in the tangent space at another point."""
    mean = jnp.asarray(space.local(sites.reference, point))
    back = jnp.linalg.inv(_change(space, sites.reference, mean, point))
    shift = sites.shift - sites.precision @ mean
    return sites._replace(precision=back.T @ sites.precision @ back, shift=shift @ back, reference=point)


def _change(space: Space, reference: Array, mean: Float[Array, " dimension"], point: Array) -> Float[Array, "dimension dimension"]:
    """Return the derivative of tangent vectors at the point with respect to those at the reference, at `mean`, which leads to the point."""
    return jax.jacfwd(lambda v: jnp.asarray(space.local(point, space.retract(reference, v))))(mean)
