r"""Find a body in one frame without any first pose: posterior draws of a loose-limbed body, from detections of its parts.

The root's place comes from the detections; all other parts from the joints' densities. Whole bodies are drawn and weighed with a small power of the
likelihood. Of the trunks that are left, limbs are drawn many times (kernels/parts/nested.py), with a larger power and then with the whole likelihood.
Trunks are drawn again by weight in between; each step's weights divide out those of the step before, so the result is a weighted sample of

$$p(x) \propto q(x_\text{root}) \prod_{\text{joints}} \psi \prod_i \phi_i(x_i),$$

where q is the mixture of the root's detections. Penetration of parts enters the weights at the end. The motion prior plays no role.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from bayes_body.density.density import Density
from bayes_body.density.graph import Mixture
from bayes_body.density.parts_graph import parts_graph
from bayes_body.kernels.parts.batching import over_particles
from bayes_body.kernels.parts.joint_particles import log_left_out
from bayes_body.kernels.parts.ladder import next_increment
from bayes_body.kernels.parts.nested import nested_draws, tree_of, trunk_draws
from bayes_body.kernels.parts.resampling import resampler
from bayes_body.kernels.parts.weights import effective_sample_size, normalise
from bayes_body.shapes import Key, Scalar

# Whole bodies that are drawn first, trunks that are kept of them, particles of a limb, and powers of the likelihood after the first.
BODIES, TRUNKS, LIMBS = 8_192, 256, 48
POWERS = (0.4, 1.0)
# The first power leaves this share of the trunks effective.
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


def search(key: Key, density: Density, roots: Mixture) -> Search:
    """Return draws of the body in a frame. Compile it once for all frames (`jax.jit`).

    Args:
        key: random key.
        density: the frame's density; its motion prior is not read.
        roots: a mixture for each part (`proposals_of`), of which the first part's is read.

    Raises:
        InputError: the body is not placed by parts, or its joints are no densities to draw from.
    """
    root_key, trunk_key, body_key, pick_key, limbs_key = jax.random.split(key, 5)
    graph = parts_graph(density, "the search for a first pose")
    tree, resample = tree_of(graph), resampler("systematic")
    bodies = trunk_draws(trunk_key, graph, tree, roots.sample(root_key, BODIES)[0])
    first = nested_draws(body_key, graph, tree, bodies, 1)
    power = next_increment(first.log_estimates, EFFECTIVE * TRUNKS / BODIES, jnp.asarray(POWERS[0]))
    weights = power * first.log_estimates
    kept = resample(pick_key, weights, TRUNKS)

    def with_limbs(trunks_and_divided: tuple[Array, Array], key_and_power: tuple[Key, Array]) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
        """Draw limbs with a power of the likelihood; `divided` is what was divided out of the trunks' weights by drawing them."""
        trunks, divided = trunks_and_divided
        (key, pick), later = jax.random.split(key_and_power[0]), key_and_power[1]
        found = nested_draws(key, graph, tree, trunks, LIMBS, later)
        weights = found.log_estimates - divided
        kept = resample(pick, weights, TRUNKS)
        return (trunks[kept], found.log_estimates[kept]), (found.values, weights)

    # A loop, so that it is compiled once for all powers.
    steps = jax.random.split(limbs_key, len(POWERS)), jnp.asarray(POWERS, weights.dtype)
    _, (values, later) = jax.lax.scan(with_limbs, (bodies[kept], weights[kept]), steps)
    last = later[-1] + over_particles(lambda value, graph: log_left_out(graph, value), values[-1], graph)
    evidence = _log_mean(weights) + sum((_log_mean(each) for each in later[:-1]), _log_mean(last))
    normal = normalise(last)
    flattened = normalise(next_increment(last, LEAST_EFFECTIVE / TRUNKS, jnp.asarray(1.0)) * last)
    return Search(values[-1], flattened.log_weights, evidence, effective_sample_size(normal.log_weights))


def _log_mean(log_weights: Float[Array, " draw"]) -> Scalar:
    return jax.nn.logsumexp(log_weights) - jnp.log(log_weights.shape[0])
