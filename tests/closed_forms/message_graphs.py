"""Graphs with known answers for message passing, runs of it, and belief propagation on a grid of values.

Cases: a Gaussian chain with the smoother's answer; the tree and the grid of Lienart, Teh & Doucet 2015.
"""

import sys
from collections.abc import Mapping, Sequence

import jax
import jax.numpy as jnp
import numpy as np
import numpyro.distributions as dist

from bayes_body.density.graph import Graph
from bayes_body.density.pairwise import edge_factor, graph, node_factor, proposal
from bayes_body.kernels.messages import messages
from bayes_body.kernels.messages.schedules import schedule

MODULE = sys.modules["bayes_body.kernels.messages.particle_bp"]


def passed(built: Graph, runs: int, kind: str = "flooding", seed: int = 0, **options):
    """Independent runs of message passing, stacked."""
    chosen = MODULE.Options(**{"particles": 200, "schedule": kind, **options})
    rounds = schedule(built, chosen.schedule, chosen.iterations, chosen.annealing)
    run = jax.jit(lambda keys, built: jax.lax.map(lambda key: MODULE.pass_messages(key, built, chosen, rounds), keys))
    return run(jax.random.split(jax.random.key(seed), runs), built)


def belief_moments(found) -> tuple[np.ndarray, np.ndarray]:
    """Means and variances of the nodes' exact beliefs on the points of the joint draws, by run."""
    return moments(found.joint.log_beliefs, found.joint.points)


def moments(log_beliefs, points) -> tuple[np.ndarray, np.ndarray]:
    """Means and variances of weighted points, by run and node."""
    weights, points = np.exp(np.asarray(log_beliefs, float))[..., None], np.asarray(points, float)
    mean = np.sum(weights * points, axis=2)
    return mean, np.sum(weights * (points - mean[:, :, None]) ** 2, axis=2)


STEPS, MOVE, NOISE, FIRST = 10, 0.3, 1.0, 4.0


def random_walk() -> np.ndarray:
    rng = np.random.default_rng(1)
    path = np.cumsum(np.concatenate([2 * rng.normal(size=(1, 2)), MOVE**0.5 * rng.normal(size=(STEPS - 1, 2))]), axis=0)
    return path + NOISE**0.5 * rng.normal(size=path.shape)


def smoother(seen: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
    """Means and variances given all observations, and the log-evidence: the joint normal distribution, solved whole."""
    order = np.arange(STEPS)
    prior = FIRST + MOVE * np.minimum(order[:, None], order[None])
    marginal = prior + NOISE * np.eye(STEPS)
    gain = prior @ np.linalg.inv(marginal)
    quadratic = np.sum(seen * np.linalg.solve(marginal, seen))
    evidence = -0.5 * quadratic - np.linalg.slogdet(marginal)[1] - STEPS * np.log(2 * np.pi)
    return gain @ seen, np.diagonal(prior - gain @ prior), float(evidence)


def log_seen(seen, x):
    return jnp.sum(-0.5 * (seen - x) ** 2 / NOISE - 0.5 * jnp.log(2 * jnp.pi * NOISE))


def chain(seen: np.ndarray, near: Sequence[int] = range(STEPS), astray: Sequence[int] = ()) -> Graph:
    """The chain, with detections of the nodes `near` about what was seen, and wrong ones of the nodes `astray`, six noises away."""

    def detected(seen):
        return dist.Normal(seen, (2 * NOISE) ** 0.5).to_event(1)

    wrong = [proposal("astray", detected, list(astray), jnp.asarray(seen[list(astray)] + 6 * NOISE**0.5))] if astray else []
    return graph(
        {"x": (STEPS, 2)},
        node_factor("first", dist.Normal(0.0, FIRST**0.5).expand([2]).to_event(1), ["x_0"]),
        node_factor("seen", log_seen, parameters=jnp.asarray(seen)),
        edge_factor("step", dist.Normal(0.0, MOVE**0.5).expand([2]).to_event(1), [(i, i + 1) for i in range(STEPS - 1)]),
        proposal("near", detected, list(near), jnp.asarray(seen[list(near)])),
        *wrong,
    )


def chain_scores(
    samples: int, runs: int, kind: str = "flooding", detections: Mapping[str, Sequence[int]] = {}, **options
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Biases of means and variances in standard errors, errors of the log-evidence, and the efficiency of the means in independent draws a sample."""
    mean, variance, evidence = smoother(random_walk())
    found = passed(chain(random_walk(), **detections), runs, kind, samples=samples, **{"iterations": 6, **options})
    means, variances = belief_moments(found)
    errors, ratios = means - mean, variances / variance[:, None] - 1
    in_errors = [each.mean(0) / each.std(0, ddof=1) * runs**0.5 for each in (errors, ratios)]
    efficiency = np.mean(variance[:, None] / (errors**2).mean(0)) / samples
    return *in_errors, np.asarray(jax.vmap(lambda joint: joint.log_evidence)(found.joint), float) - evidence, efficiency


def on_grid(log_unary: np.ndarray, log_pair: np.ndarray, edges, grid: np.ndarray, iterations: int) -> np.ndarray:
    """The beliefs of loopy belief propagation on a grid, as densities (node, point): exact on a tree."""
    count = len(edges)
    sources = [a for a, _ in edges] + [b for _, b in edges]
    targets = [b for _, b in edges] + [a for a, _ in edges]
    pair, sent = np.exp(log_pair), np.zeros((2 * count, len(grid)))
    for _ in range(iterations):
        total = log_unary.copy()
        np.add.at(total, targets, sent)
        cavity = total[sources] - sent[(np.arange(2 * count) + count) % (2 * count)]
        weights = np.exp(cavity - cavity.max(1, keepdims=True))
        weights /= weights.sum(1, keepdims=True)
        sent = np.log(np.concatenate([weights[:count] @ pair, weights[count:] @ pair.T]) + 1e-300)
    total = log_unary.copy()
    np.add.at(total, targets, sent)
    belief = np.exp(total - total.max(1, keepdims=True))
    return belief / (belief.sum(1, keepdims=True) * (grid[1] - grid[0]))


def beliefs_at(found, built: Graph, grid: np.ndarray) -> np.ndarray:
    """The beliefs of each run as densities at the points of a grid."""

    def of(run):
        beliefs, cavities = run
        points = jnp.broadcast_to(jnp.asarray(grid, beliefs.points.dtype)[None, :, None], (built.count, len(grid), 1))
        likelihood, rest = messages.unary_values(built, points)
        total = likelihood + rest
        for term, cavity in zip(built.pairs, cavities, strict=True):
            rows, every = jnp.asarray(term.rows), jnp.arange(len(term.plate.rows))
            sent = messages.log_messages(term, messages.sources(term, cavity, beliefs.points, beliefs.ready), points, (every, every))
            total = total.at[rows[:, 1]].add(sent.forward).at[rows[:, 0]].add(sent.backward)
        return jax.nn.softmax(total, axis=1)

    return np.asarray(jax.jit(lambda all_runs: jax.lax.map(of, all_runs))((found.beliefs, found.cavities)), float) / (grid[1] - grid[0])


def log_gumbel(z, loc, scale):
    z = (z - loc) / scale
    return -z - jnp.exp(-jnp.maximum(z, -50.0)) - jnp.log(scale)


def log_normal(x, mean, sd):
    return -0.5 * ((x - mean) / sd) ** 2 - jnp.log(sd * jnp.sqrt(2 * jnp.pi))


def log_tree_node(seen, x):
    return jnp.logaddexp(jnp.log(0.7) + log_normal(seen - x[0], -2.0, 1.0), jnp.log(0.3) + log_gumbel(seen - x[0], 1.0, 1.5))


def log_grid_node(seen, x):
    return jnp.logaddexp(jnp.log(0.6) + log_normal(seen - x[0], -2.0, 1.0), jnp.log(0.4) + log_gumbel(seen - x[0], 2.0, 1.3))


def distance(densities: np.ndarray, exact: np.ndarray, grid: np.ndarray) -> np.ndarray:
    """Total variation, by run and node."""
    return 0.5 * np.abs(densities - exact).sum(axis=-1) * (grid[1] - grid[0])


def wide(seen):
    return dist.Normal(seen, 4.0).expand([1]).to_event(1)


TREE = ((0, 1), (0, 2), (1, 3), (1, 4), (2, 5), (2, 6), (6, 7))
LATTICE = [(5 * i + j, 5 * i + j + 1) for i in range(5) for j in range(4)] + [(5 * i + j, 5 * i + j + 5) for i in range(4) for j in range(5)]


def heavy_tree() -> tuple[Graph, np.ndarray, np.ndarray]:
    """The tree with heavy tails, a grid of values, and the exact marginals there."""
    seen, grid = jnp.asarray(np.random.default_rng(3).normal(size=8) * 3), np.linspace(-25, 25, 2001)
    log_pair = -np.log(np.pi * (1 + (grid[:, None] - grid[None]) ** 2))
    return _noisy(log_tree_node, seen, dist.Cauchy(0.0, 1.0), TREE, grid, log_pair, 8)


def lattice() -> tuple[Graph, np.ndarray, np.ndarray]:
    """The grid of 5 by 5 nodes, a grid of values, and the fixed point of belief propagation there."""
    seen, grid = jnp.asarray(np.random.default_rng(4).normal(size=25) * 2), np.linspace(-20, 20, 801)
    log_pair = -np.abs(grid[:, None] - grid[None]) / 2 - np.log(4)
    return _noisy(log_grid_node, seen, dist.Laplace(0.0, 2.0), LATTICE, grid, log_pair, 30)


def _noisy(log_node, seen, noise, edges, grid, log_pair, iterations):
    parts = (
        node_factor("seen", log_node, parameters=seen),
        edge_factor("edge", noise.expand([1]).to_event(1), edges),
        proposal("near", wide, parameters=seen),
    )
    unary = np.asarray(jax.vmap(lambda s: jax.vmap(lambda x: log_node(s, x[None]))(grid))(seen), float)
    return graph({"x": (len(seen), 1)}, *parts), grid, on_grid(unary, log_pair, edges, grid, iterations)
