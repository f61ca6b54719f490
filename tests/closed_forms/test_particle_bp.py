"""Particle belief propagation against exact answers: Gaussian chains, belief propagation on a grid, products of mixtures, doors, and loops.

Cases: Lienart, Teh & Doucet 2015 (tree and grid), Ihler's toolbox for kernel density estimates (product), and localisation by ambiguous doors.
"""

import sys
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import numpyro.distributions as dist
import pytest

from bayes_body.density.graph import Graph
from bayes_body.density.pairwise import edge_factor, graph, node_factor, proposal
from bayes_body.kernels.parts import messages, node_proposals, passing
from bayes_body.kernels.parts.messages import log_beliefs, normalised
from bayes_body.kernels.parts.schedules import schedule

# These programs run for longer than they compile.
pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("optimised")]

MODULE = sys.modules["bayes_body.kernels.particle_bp"]


def passed(built: Graph, runs: int, kind: str = "flooding", seed: int = 0, **options):
    """Independent runs of message passing, stacked."""
    chosen = MODULE.Options(**{"particles": 200, "schedule": kind, **options})
    rounds = schedule(built, chosen.schedule, chosen.iterations, chosen.annealing)
    run = jax.jit(lambda keys, built: jax.lax.map(lambda key: MODULE.pass_messages(key, built, chosen, rounds), keys))
    return run(jax.random.split(jax.random.key(seed), runs), built)


def belief_moments(found) -> tuple[np.ndarray, np.ndarray]:
    """Means and variances of the nodes' exact beliefs on the points of the joint draws, by run."""
    weights, points = np.exp(np.asarray(found.joint.log_beliefs, float))[..., None], np.asarray(found.joint.points, float)
    mean = np.sum(weights * points, axis=2)
    return mean, np.sum(weights * (points - mean[:, :, None]) ** 2, axis=2)


# -- a Gaussian chain -------------------------------------------------------------------------------------------------------------------------

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


def chain(seen: np.ndarray) -> Graph:
    return graph(
        {"x": (STEPS, 2)},
        node_factor("first", dist.Normal(0.0, FIRST**0.5).expand([2]).to_event(1), ["x_0"]),
        node_factor("seen", log_seen, parameters=jnp.asarray(seen)),
        edge_factor("step", dist.Normal(0.0, MOVE**0.5).expand([2]).to_event(1), [(i, i + 1) for i in range(STEPS - 1)]),
        proposal("near", lambda seen: dist.Normal(seen, (2 * NOISE) ** 0.5).to_event(1), parameters=jnp.asarray(seen)),
    )


def chain_scores(samples: int, runs: int, kind: str = "flooding", iterations: int = 6) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Biases of means and variances in standard errors, errors of the log-evidence, and the efficiency of the means in independent draws a sample."""
    mean, variance, evidence = smoother(random_walk())
    found = passed(chain(random_walk()), runs, kind, samples=samples, iterations=iterations)
    means, variances = belief_moments(found)
    errors, ratios = means - mean, variances / variance[:, None] - 1
    in_errors = [each.mean(0) / each.std(0, ddof=1) * runs**0.5 for each in (errors, ratios)]
    efficiency = np.mean(variance[:, None] / (errors**2).mean(0)) / samples
    return *in_errors, np.asarray(jax.vmap(lambda joint: joint.log_evidence)(found.joint), float) - evidence, efficiency


@pytest.mark.parametrize(("kind", "iterations"), [("flooding", 6), ("tree", 2)])
def test_a_gaussian_chain_is_exact(kind, iterations):
    means, variances, evidence, efficiency = chain_scores(200, 30, kind, iterations)
    assert np.sqrt(np.mean(means**2)) < 1.6 and np.abs(means).max() < 4.5
    assert np.sqrt(np.mean(variances**2)) < 1.8
    # The estimate of the evidence itself is unbiased.
    ratio = np.exp(evidence)
    assert abs(ratio.mean() - 1) < 4 * ratio.std() / len(ratio) ** 0.5
    assert efficiency > 0.35


def test_joint_draws_of_a_chain_have_equal_weights():
    found = passed(chain(random_walk()), 4, samples=200, iterations=4)
    log_weights = np.asarray(found.joint.log_weights, float)
    assert np.ptp(log_weights, axis=1).max() < 1e-3
    # Neighbours of a draw belong together: their differences have the posterior's variance, which independent nodes would exceed.
    order = np.arange(STEPS)
    prior = FIRST + MOVE * np.minimum(order[:, None], order[None])
    posterior = prior - prior @ np.linalg.solve(prior + NOISE * np.eye(STEPS), prior)
    difference = posterior[4, 4] + posterior[5, 5] - 2 * posterior[4, 5]
    values = np.asarray(found.joint.values, float)
    assert np.var(values[:, :, 5] - values[:, :, 4]) == pytest.approx(difference, rel=0.15)


def keeping(module, name):
    """The function of a module, for mutants that change what it returns."""
    return getattr(module, name)


def without_division(graph, own, points, sent, prior, kept=keeping(node_proposals, "log_density")):
    return 0 * kept(graph, own, points, sent, prior)


def with_own_message(total, message):
    del message
    return total


MUTANTS = {"no division by q": (passing, "log_density", without_division), "own message kept": (messages, "_without", with_own_message)}


@pytest.mark.parametrize("mutant", MUTANTS)
def test_a_wrong_weight_is_found_out(monkeypatch, mutant):
    module, name, function = MUTANTS[mutant]
    monkeypatch.setattr(module, name, function)
    found = passed(chain(random_walk()), 10, samples=200, iterations=6)
    # Beliefs by message passing alone: the exact sum at the end would mend a message that is only a poor proposal.
    weights = np.exp(np.asarray(normalised(jax.vmap(partial(log_beliefs, chain(random_walk())))(found.beliefs)), float))[..., None]
    points = np.asarray(found.beliefs.points, float)
    mean = np.sum(weights * points, axis=2)
    variance = np.sum(weights * (points - mean[:, :, None]) ** 2, axis=2)
    assert np.mean(variance) < 0.8 * np.mean(smoother(random_walk())[1])


# -- trees and loops, against belief propagation on a grid ------------------------------------------------------------------------------------


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

    def of(beliefs):
        points = jnp.broadcast_to(jnp.asarray(grid, beliefs.points.dtype)[None, :, None], (built.count, len(grid), 1))
        likelihood, rest = messages.unary_values(built, points)
        total = likelihood + rest
        for term, cavity in zip(built.pairs, messages.cavities(built, beliefs), strict=True):
            rows, every = jnp.asarray(term.rows), jnp.arange(len(term.plate.rows))
            sent = messages.log_messages(term, cavity, beliefs.points, points, beliefs.ready, (every, every))
            total = total.at[rows[:, 1]].add(sent.forward).at[rows[:, 0]].add(sent.backward)
        return jax.nn.softmax(total, axis=1)

    return np.asarray(jax.jit(lambda all_runs: jax.lax.map(of, all_runs))(found.beliefs), float) / (grid[1] - grid[0])


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


def test_a_tree_with_heavy_tails_has_the_beliefs_of_a_grid():
    edges = ((0, 1), (0, 2), (1, 3), (1, 4), (2, 5), (2, 6), (6, 7))
    seen, grid = jnp.asarray(np.random.default_rng(3).normal(size=8) * 3), np.linspace(-25, 25, 2001)
    heavy = dist.Cauchy(0.0, 1.0).expand([1]).to_event(1)
    built = graph(
        {"x": (8, 1)}, node_factor("seen", log_tree_node, parameters=seen), edge_factor("edge", heavy, edges), proposal("near", wide, parameters=seen)
    )
    unary = np.asarray(jax.vmap(lambda s: jax.vmap(lambda x: log_tree_node(s, x[None]))(grid))(seen), float)
    exact = on_grid(unary, -np.log(np.pi * (1 + (grid[:, None] - grid[None]) ** 2)), edges, grid, 8)
    found = distance(beliefs_at(passed(built, 10, samples=100, iterations=5), built, grid), exact, grid)
    assert found.mean() < 0.05
    assert found.mean(0).max() < 0.09


LATTICE = [(5 * i + j, 5 * i + j + 1) for i in range(5) for j in range(4)] + [(5 * i + j, 5 * i + j + 5) for i in range(4) for j in range(5)]


def test_on_loops_messages_reach_the_fixed_point_of_the_grid():
    """They are not the true marginals: that is belief propagation's own error. With more samples the distance to its fixed point falls."""
    seen, grid = jnp.asarray(np.random.default_rng(4).normal(size=25) * 2), np.linspace(-20, 20, 801)
    built = graph(
        {"x": (25, 1)},
        node_factor("seen", log_grid_node, parameters=seen),
        edge_factor("edge", dist.Laplace(0.0, 2.0).expand([1]).to_event(1), LATTICE),
        proposal("near", wide, parameters=seen),
    )
    unary = np.asarray(jax.vmap(lambda s: jax.vmap(lambda x: log_grid_node(s, x[None]))(grid))(seen), float)
    exact = on_grid(unary, -np.abs(grid[:, None] - grid[None]) / 2 - np.log(4), LATTICE, grid, 30)
    few, many = (distance(beliefs_at(passed(built, 5, samples=n, iterations=10), built, grid), exact, grid).mean() for n in (50, 150))
    assert few < 0.06 and many < 0.04


def test_weights_of_joint_draws_correct_a_loop():
    """Three nodes in a circle: beliefs are too narrow (Weiss & Freeman 2001), weighted joint draws are not."""
    pull, noise = 0.5, 1.0
    seen = jnp.asarray([1.0, -0.5, 0.3])
    edges = [(0, 1), (1, 2), (2, 0)]
    built = graph(
        {"x": (3, 1)},
        node_factor("seen", lambda seen, x: log_normal(x[0], seen, noise), parameters=seen),
        edge_factor("edge", dist.Normal(0.0, pull).expand([1]).to_event(1), edges),
        proposal("near", lambda seen: dist.Normal(seen, 2.0).expand([1]).to_event(1), parameters=seen),
    )
    precision = np.eye(3) / noise**2 + (3 * np.eye(3) - np.ones((3, 3))) / pull**2
    covariance, mean = np.linalg.inv(precision), np.linalg.solve(precision, np.asarray(seen) / noise**2)
    found = passed(built, 20, samples=400, iterations=12, particles=1000)
    weights = np.asarray(jax.nn.softmax(found.joint.log_weights, axis=1), float)[..., None, None]
    values = np.asarray(found.joint.values, float)
    centre = np.sum(weights * values, axis=1)
    variance = np.sum(weights * (values - mean[:, None]) ** 2, axis=1)[..., 0]
    error = centre.std(0, ddof=1) / 20**0.5
    assert np.all(np.abs(centre.mean(0)[:, 0] - mean) < 4 * error[:, 0])
    assert np.all(np.abs(variance.mean(0) - np.diagonal(covariance)) < 4 * variance.std(0, ddof=1) / 20**0.5)
    grid = np.linspace(-4, 4, 401)
    belief = beliefs_at(found, built, grid).mean(0) * (grid[1] - grid[0])
    narrow = belief @ grid**2 - (belief @ grid) ** 2
    assert np.all(narrow < 0.8 * np.diagonal(covariance))


# -- one node, and beliefs with several peaks -------------------------------------------------------------------------------------------------


def mixture_of(means, sd):
    return dist.MixtureSameFamily(
        dist.Categorical(probs=jnp.full(len(means), 1 / len(means))), dist.Normal(jnp.asarray(means), sd).expand([len(means)])
    )


def test_the_product_of_two_density_estimates():
    one, other = [0.1, 0.45, 0.55, 0.8], [0.25, 0.35, 0.7, 0.75]
    parts = [
        node_factor("one", lambda x: mixture_of(one, 0.05).log_prob(x[0])),
        node_factor("other", lambda x: mixture_of(other, 0.05).log_prob(x[0])),
        proposal("range", dist.Uniform(0.0, 1.0).expand([1]).to_event(1)),
    ]
    found = passed(graph({"x": (1, 1)}, *parts), 10, samples=500, iterations=2, particles=2000)
    grid = np.linspace(0, 1, 4001)
    exact = np.exp(np.asarray(mixture_of(one, 0.05).log_prob(grid) + mixture_of(other, 0.05).log_prob(grid), float))
    cumulative = np.cumsum(exact) / exact.sum()
    edges = np.interp(np.linspace(0, 1, 21)[1:-1], cumulative, grid)
    values, weights = (np.asarray(each, float) for each in (found.joint.values[..., 0, 0], jax.nn.softmax(found.joint.log_weights, axis=1)))
    shares = np.histogram(values.ravel(), np.concatenate([[-1], edges, [2]]), weights=weights.ravel())[0] / 10
    assert 0.5 * np.abs(shares - 1 / 20).sum() < 0.05


def test_three_doors():
    """A robot sees a door, walks 3 m, sees none, walks 2 m and sees one again: two of nine places remain, with known masses."""
    doors, width = jnp.asarray([1.0, 4.0, 6.0]), 0.2

    def log_door(seen, x):
        door = jnp.exp(jax.nn.logsumexp(log_normal(x[0], doors, width)) + jnp.log(width * jnp.sqrt(2 * jnp.pi)))
        return jnp.log(jnp.where(seen > 0, 0.02 + 0.9 * door, 0.98 - 0.9 * door))

    steps, sd = jnp.asarray([3.0, 2.0]), 0.15
    built = graph(
        {"x": (3, 1)},
        node_factor("door", log_door, parameters=jnp.asarray([1.0, 0.0, 1.0])),
        edge_factor("step", lambda step: dist.Normal(step, sd).expand([1]).to_event(1), [(0, 1), (1, 2)], parameters=steps),
        node_factor("corridor", dist.Uniform(-2.0, 12.0).expand([1]).to_event(1), [0]),
    )
    grid = np.linspace(-4, 18, 4401)
    step = [np.exp(np.asarray(log_normal(grid[None] - grid[:, None], float(by), sd), float)) for by in steps]
    at = jax.vmap(log_door, (None, 0))
    seen = [np.exp(np.asarray(at(flag, grid[:, None]), float)) for flag in (1.0, 0.0, 1.0)]
    start = seen[0] * ((grid >= -2) & (grid <= 12))
    exact = ((start @ step[0]) * seen[1] @ step[1]) * seen[2]
    exact /= exact.sum()
    found = passed(built, 10, samples=400, iterations=6, particles=1000)
    values, weights = (np.asarray(each, float) for each in (found.joint.values[..., 2, 0], jax.nn.softmax(found.joint.log_weights, axis=1)))
    for low, high in ((5.5, 6.5), (3.5, 4.5), (8.0, 12.0)):
        masses = np.sum(weights * ((values > low) & (values < high)), axis=1)
        mass = exact[(grid > low) & (grid < high)].sum()
        assert abs(masses.mean() - mass) < 4 * masses.std(ddof=1) / 10**0.5 + 0.01
