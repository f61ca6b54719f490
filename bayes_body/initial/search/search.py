r"""Find a body in one frame without any first pose: posterior draws of a loose-limbed body, from detections of its parts.

The root's place comes from the detections; all other parts from the joints' densities. Whole bodies are drawn and weighed with a small power of the
likelihood. Of the trunks that are left, limbs are drawn many times (kernels/messages/nested.py), with a larger power and then with the whole
likelihood. Trunks are drawn again by weight in between; each stage's weights divide out those of the stage before, so the result is a weighted sample
of

$$p(x) \propto q(x_\text{root}) \prod_{\text{joints}} \psi \prod_i \phi_i(x_i),$$

where q is the mixture of the root's detections. Penetration of parts enters the weights at the end. The motion prior plays no role.

All stages are one loop, so that the likelihood of a part is compiled once for all limbs. In the first stage, the particles of a limb belong to as
many trunks.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from bayes_body.base.shapes import Flag, Key, Scalar
from bayes_body.density.density import Density
from bayes_body.density.graph import Graph, Mixture
from bayes_body.density.parts_graph import parts_graph
from bayes_body.kernels.batching import over_particles
from bayes_body.kernels.messages.joint_particles import log_left_out
from bayes_body.kernels.messages.nested import Tree, Trunks, nested_draws, tree_of, trunk_draws
from bayes_body.kernels.resampling import resampler
from bayes_body.kernels.smc.ladder import next_increment
from bayes_body.kernels.weights import effective_sample_size, normalise

# Trunks that are kept, and particles of a limb. Their product is the number of whole bodies that are drawn first.
TRUNKS, LIMBS = 256, 48
# Powers of the likelihood in each stage. The first stage weighs its bodies by a power of their likelihood, at most the second number.
POWERS, FIRST_POWER = (1.0, 0.4, 1.0), 0.4
# That power leaves this share of the trunks effective.
EFFECTIVE = 0.5
# If fewer draws are effective at the end, their weights are raised to the power with which so many are. A mean of one draw or two has the whole
# error of a draw, and a sampler that starts there does not know how uncertain its start is.
LEAST_EFFECTIVE = 20


class Search(NamedTuple):
    """Weighted draws of the parts.

    Attributes:
        parts: the draws.
        log_weights: their log-weights, normalised; flattened, if fewer than LEAST_EFFECTIVE draws were effective.
        log_evidence: log of the mean likelihood over the prior of the search.
        ess: effective number of draws by the weights that are not flattened.
    """

    parts: Float[Array, "draw part 7"]
    log_weights: Float[Array, " draw"]
    log_evidence: Scalar
    ess: Scalar


class _Stage(NamedTuple):
    """The trunks of all bodies, (TRUNKS, LIMBS, ...), and the log of what was divided out of their weights by drawing them."""

    trunks: Trunks
    divided: Float[Array, "trunk limb"]


def search(key: Key, density: Density, roots: Mixture) -> Search:
    """Return draws of the body in a frame. Compile it once for all frames (`jax.jit`).

    Args:
        key: random key.
        density: the frame's density; its motion prior is not read.
        roots: a mixture for each part (`proposals_of`), of which the first part's is read.

    Raises:
        InputError: the body is not placed by parts, or its joints are no densities to draw from.
    """
    root_key, trunk_key, *stage_keys = jax.random.split(key, 2 + 2 * len(POWERS))
    graph = parts_graph(density, "the search for a first pose")
    tree = tree_of(graph)
    trunks = trunk_draws(trunk_key, graph, tree, _roots(root_key, roots))
    start = jax.tree.map(lambda leaf: leaf.reshape(TRUNKS, LIMBS, *leaf.shape[1:]), trunks)
    powers = jnp.asarray(POWERS, trunks.values.dtype)
    stages = jnp.stack(stage_keys).reshape(len(POWERS), 2), powers, jnp.arange(len(POWERS)) == 0
    # A loop, so that it is compiled once for all stages.
    _, (values, weights) = jax.lax.scan(
        lambda state, stage: _stage(graph, tree, state, *stage), _Stage(start, jnp.zeros((TRUNKS, LIMBS), powers.dtype)), stages
    )
    last = weights[-1, :, 0] + over_particles(lambda value, graph: log_left_out(graph, value), values[-1], graph)
    evidence = _log_mean(last) + sum(_log_mean(weights[stage].ravel()) for stage in range(len(POWERS) - 1))
    normal = normalise(last)
    flattened = normalise(next_increment(last, LEAST_EFFECTIVE / TRUNKS, jnp.asarray(1.0)) * last)
    return Search(values[-1], flattened.log_weights, evidence, effective_sample_size(normal.log_weights))


def _roots(key: Key, roots: Mixture) -> Float[Array, "body 7"]:
    """Return draws of the first part, as many as bodies are drawn; the components are drawn by systematic resampling."""
    choice, noise = jax.random.split(key)
    index = resampler("systematic")(choice, roots.log_weights[0], TRUNKS * LIMBS)
    chosen = jax.tree.map(lambda leaf: leaf[0][index], roots.components)
    normals = jax.random.normal(noise, (len(index), chosen.root.shape[-1]), chosen.root.dtype)
    return jax.vmap(lambda component, steps: jnp.asarray(component.space.retract(component.mean, component.root @ steps)))(chosen, normals)


def _stage(graph: Graph, tree: Tree, state: _Stage, keys: Key, power: Scalar, is_first: Flag) -> tuple[_Stage, tuple[Array, Array]]:
    """Draw limbs with a power of the likelihood. Return the trunks that are drawn by weight, and the bodies with the weights of their trunks."""
    limbs_key, resample_key = keys
    drawn = nested_draws(limbs_key, graph, tree, state.trunks.values, power, ~is_first)
    terms = state.trunks.terms
    estimates = drawn.log_estimates + power * terms.likelihood + terms.potential
    estimates = jnp.where(jnp.isnan(estimates), -jnp.inf, estimates)
    # After the first stage, the trunks of a row are equal, and so are their weights.
    flat = next_increment(estimates.ravel(), EFFECTIVE / LIMBS, jnp.asarray(FIRST_POWER))
    estimates = jnp.where(is_first, flat * estimates, estimates)
    weights = estimates - state.divided
    chosen = resampler("systematic")(resample_key, weights.ravel(), TRUNKS)

    def rows_of(leaf: Array) -> Array:
        rows = leaf.reshape(-1, *leaf.shape[2:])[chosen]
        return jnp.broadcast_to(rows[:, None], leaf.shape)

    return jax.tree.map(rows_of, _Stage(state.trunks, estimates)), (drawn.values, weights)


def _log_mean(log_weights: Float[Array, " draw"]) -> Scalar:
    return jax.nn.logsumexp(log_weights) - jnp.log(log_weights.shape[0])
