r"""Find a body in one frame without any first pose, by posterior draws of a loose-limbed body; and tell from several frames which way it faces.

The root is drawn from the detections, and all other parts from the joints' densities. Whole bodies are drawn and weighted with a small power of the
likelihood. The remaining trunks get new limbs, many for each trunk (kernels/messages/nested.py), with a larger power and then with the whole
likelihood. Trunks are drawn again by weight in between. Each stage divides the weights of the stage before out of its own, so the result is a
weighted sample of

$$p(x) \propto q(x_\text{root}) \prod_{\text{joints}} \psi \prod_i \phi_i(x_i),$$

where q is the mixture of the root's detections. Penetration of parts enters the weights at the end. The motion prior plays no role.

All stages are one loop, so that the likelihood of a part is compiled once for all limbs. In the first stage, each particle of a limb has a trunk of
its own.

Silhouettes tell little about front and back: a body and the same body turned round by 180 degrees may explain one frame about equally well. The draws
of a frame are therefore kept apart by the way they face, and frames that are near in time decide together. From frame to frame the facing turns
slowly, and people walk forwards. Let way k of frame t have the evidence $Z_{tk}$ and the facing angle $a_{tk}$. The ways of all frames form a hidden
Markov chain,

$$p(k_{1:T}) \propto \prod_t Z_{t k_t}^{\gamma}\, \exp\{\kappa_t \cos(a_{t k_t} - a_{t-1, k_{t-1}})\}\, m_t(a_{t k_t})^{1/T},$$

where m is the density of the person's movement given the facing $a$, relative to a uniform distribution of directions. The forward and backward
recursions give the share of each way (Rabiner 1989). The exponent $\gamma$ is below 1, because frames that are near in time misfit the model in the
same way.
"""

from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray, Shaped

from bayes_body.base.shapes import Flag, Key, Scalar
from bayes_body.density.density import Density
from bayes_body.density.graph import Graph, Mixture
from bayes_body.density.parts_graph import parts_graph
from bayes_body.kernels.batching import over_particles
from bayes_body.kernels.messages.joint_particles import log_left_out
from bayes_body.kernels.messages.nested import Tree, Trunks, nested_draws, tree_of, trunk_draws
from bayes_body.kernels.smc.tempering import next_increment
from bayes_body.kernels.weights import effective_sample_size, normalise, resampler

# Number of trunks that are kept, and of particles of a limb. Their product is the number of whole bodies that are drawn first.
TRUNKS, LIMBS = 256, 48
# Powers of the likelihood in each stage. The first stage weighs its bodies by a power of their likelihood, at most the second number.
POWERS, FIRST_POWER = (1.0, 0.4, 1.0), 0.4
# The power of the first stage leaves this share of the trunks effective.
EFFECTIVE = 0.5
# If fewer draws are effective at the end, their weights are raised to the power at which this many are. A mean of one or two draws has the whole
# error of a draw, and a sampler that starts there does not know how uncertain its start is.
LEAST_EFFECTIVE = 20


class Search(NamedTuple):
    """Weighted draws of the parts.

    Attributes:
        parts: the draws.
        log_weights: their log-weights, normalised; flattened, if fewer than LEAST_EFFECTIVE draws were effective.
        log_evidence: log of the mean likelihood over the prior of the search.
        ess: effective number of draws, by the weights before they are flattened.
    """

    parts: Float[Array, "draw part 7"]
    log_weights: Float[Array, " draw"]
    log_evidence: Scalar
    ess: Scalar


class _Stage(NamedTuple):
    """The trunks of all bodies, (TRUNKS, LIMBS, ...), and the log-weights by which they were drawn, which are divided out later."""

    trunks: Trunks
    divided: Float[Array, "trunk limb"]


def search(key: Key, density: Density, roots: Mixture) -> Search:
    """Return draws of the body in a frame. Compile it once for all frames (`jax.jit`).

    Args:
        key: random key.
        density: the frame's density; its motion prior is not read.
        roots: a mixture for each part (`proposals_of`); only that of the first part is read.

    Raises:
        InputError: the body is not placed by parts, or its joints are not densities that can be drawn from.
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


def _stage(
    graph: Graph, tree: Tree, state: _Stage, keys: Shaped[PRNGKeyArray, "2"], power: Scalar, is_first: Flag
) -> tuple[_Stage, tuple[Array, Array]]:
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


# How fast people turn, radians a second, and how well a frame's facing is known, radians: standard deviations.
TURN_RAD_S, FACING_RAD = 2.0, 0.35
# Share of the people who walk backwards or sideways; the least speed of a walk, metres a second; and how closely walkers face their direction of
# movement: concentration of a von Mises distribution.
BACKWARDS, WALKS_M_S, STRAIGHT = 0.02, 0.3, 4.0
# γ
TRUST = 0.5


class Way(NamedTuple):
    """The draws of one frame that face one way.

    Attributes:
        markers: the draws' markers, metres.
        log_weights: their normalised log-weights.
        log_evidence: log-evidence of the frame, if the person faces this way.
        ess: effective number of draws.
        facing: horizontal unit vector to where the mean body faces.
        place: the mean body's pelvis, metres.
    """

    markers: Float[np.ndarray, "draw marker 3"]
    log_weights: Float[np.ndarray, " draw"]
    log_evidence: float
    ess: float
    facing: Float[np.ndarray, "3"]
    place: Float[np.ndarray, "3"]


def way_of(names: Sequence[str], markers: np.ndarray, log_weights: np.ndarray, log_evidence: float, ess: float, up: int) -> Way:
    """Return the way of weighted draws of markers. Its facing is the mean direction from right to left hip, turned forward."""
    weights = np.exp(log_weights)
    hip_axis = markers[:, names.index("l_hip")] - markers[:, names.index("r_hip")]
    forward = np.cross(hip_axis, np.eye(3)[up])
    forward = weights @ (forward / np.maximum(np.linalg.norm(forward, axis=1, keepdims=True), 1e-9))
    facing = forward / max(float(np.linalg.norm(forward)), 1e-9)
    return Way(markers, log_weights, log_evidence, ess, facing, weights @ markers[:, names.index("pelvis")])


def shares_over_time(frames: Sequence[Sequence[Way]], seconds: Sequence[float], up: int) -> list[Float[np.ndarray, " way"]]:
    """Return the share of each way of each frame, given all frames.

    Args:
        frames: the ways of each frame, in order of time; one or more a frame.
        seconds: when each frame was taken.
        up: index of the world's axis that points up.
    """
    log_potentials = [TRUST * np.array([way.log_evidence for way in ways]) for ways in frames]
    for frame, moved in enumerate(_movements(frames, seconds, up)):
        log_potentials[frame] = log_potentials[frame] + np.array([_log_forwards(way.facing, moved) for way in frames[frame]]) / len(frames)
    links = [_log_turns(frames[k], frames[k + 1], seconds[k + 1] - seconds[k]) for k in range(len(frames) - 1)]
    forward, backward = [log_potentials[0]], [np.zeros_like(log_potentials[-1])]
    for link, log_potential in zip(links, log_potentials[1:], strict=True):
        forward.append(log_potential + np.logaddexp.reduce(forward[-1][:, None] + link, axis=0))
    for link, next_potential in zip(links[::-1], log_potentials[:0:-1], strict=True):
        backward.append(np.logaddexp.reduce(link + (next_potential + backward[-1])[None], axis=1))
    log_marginals = [log_forward + log_backward for log_forward, log_backward in zip(forward, backward[::-1], strict=True)]
    return [np.exp(log_marginal - np.logaddexp.reduce(log_marginal)) for log_marginal in log_marginals]


def _log_turns(earlier_ways: Sequence[Way], later_ways: Sequence[Way], seconds: float) -> Float[np.ndarray, "before after"]:
    """Return the log-density of the turns between two frames, up to a constant."""
    concentration = 1 / (FACING_RAD**2 + (TURN_RAD_S * seconds) ** 2)
    return concentration * np.array([[earlier_way.facing @ later_way.facing for later_way in later_ways] for earlier_way in earlier_ways])


def _movements(frames: Sequence[Sequence[Way]], seconds: Sequence[float], up: int) -> Float[np.ndarray, "frame 3"]:
    """Return the horizontal velocity of the person in each frame, metres a second; the ways of a frame are at about the same place."""
    if len(frames) < 2:
        return np.zeros((len(frames), 3))
    places = np.stack([np.mean([way.place for way in ways], axis=0) for ways in frames])
    places[:, up] = 0
    return np.gradient(places, np.asarray(seconds, float), axis=0)


def _log_forwards(facing: Float[np.ndarray, "3"], moved: Float[np.ndarray, "3"]) -> float:
    """Return the log-density of a movement given a facing, relative to a uniform distribution of directions."""
    speed = float(np.linalg.norm(moved))
    if speed < WALKS_M_S:
        return 0.0
    straight = np.exp(STRAIGHT * float(facing @ moved) / speed) / np.i0(STRAIGHT)
    return float(np.log((1 - BACKWARDS) * straight + BACKWARDS))
