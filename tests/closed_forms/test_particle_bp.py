"""Particle belief propagation against exact answers: Gaussian chains, belief propagation on a grid, products of mixtures, doors, and loops.

Cases: Lienart, Teh & Doucet 2015 (tree and grid), Ihler's toolbox for kernel density estimates (product), and localisation by ambiguous doors.
"""

import jax
import jax.numpy as jnp
import numpy as np
import numpyro.distributions as dist
import pytest
from closed_forms.message_graphs import (
    FIRST,
    MOVE,
    NOISE,
    STEPS,
    beliefs_at,
    chain,
    chain_scores,
    distance,
    heavy_tree,
    lattice,
    log_normal,
    moments,
    passed,
    random_walk,
    smoother,
)

from bayes_body.density.pairwise import edge_factor, graph, node_factor, proposal
from bayes_body.kernels.messages import messages, node_proposals, passing
from bayes_body.kernels.messages.passing import Passing

pytestmark = pytest.mark.slow
# Many runs or many particles: for longer than they compile.
OPTIMISED = pytest.mark.usefixtures("optimised")

# -- a Gaussian chain -------------------------------------------------------------------------------------------------------------------------


# Nothing is detected of two nodes, and what is detected of two others is wrong.
ASTRAY = {"near": [0, 1, 2, 4, 5, 6, 7, 9], "astray": [2, 6]}


@pytest.mark.parametrize(
    ("kind", "iterations", "detections"),
    [("flooding", 6, {}), pytest.param("flooding", 6, ASTRAY, marks=pytest.mark.long), pytest.param("tree", 2, {}, marks=pytest.mark.long)],
)
def test_a_gaussian_chain_is_exact(kind, iterations, detections):
    means, variances, evidence, efficiency = chain_scores(200, 30, kind, detections, iterations=iterations)
    assert np.sqrt(np.mean(means**2)) < 1.6 and np.abs(means).max() < 4.5
    assert np.sqrt(np.mean(variances**2)) < 1.8
    # The estimate of the evidence itself is unbiased.
    ratio = np.exp(evidence)
    assert abs(ratio.mean() - 1) < 4 * ratio.std() / len(ratio) ** 0.5
    assert efficiency > 0.35


@pytest.mark.long
@OPTIMISED
def test_without_a_share_for_detections_the_first_particles_still_come_from_them():
    ratio = np.exp(chain_scores(200, 20, shares=(0.5, 0.0, 0.0, 0.5))[2])
    assert abs(ratio.mean() - 1) < 4 * ratio.std() / len(ratio) ** 0.5


@pytest.mark.long
@OPTIMISED
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


@pytest.mark.long
@OPTIMISED
@pytest.mark.parametrize("mutant", list(MUTANTS))
def test_a_wrong_weight_is_found_out(monkeypatch, mutant):
    module, name, function = MUTANTS[mutant]
    monkeypatch.setattr(module, name, function)
    found = passed(chain(random_walk()), 10, samples=200, iterations=6)
    # Beliefs by message passing alone: the exact sum at the end would mend a message that is only a poor proposal.
    assert np.mean(moments(found.log_beliefs, found.points)[1]) < 0.8 * np.mean(smoother(random_walk())[1])


def stale(term, come_from, targets, rows, kept=keeping(messages, "log_messages")):
    """Messages at other points than those of the last pass: each point has its neighbour's."""
    return kept(term, come_from, jnp.roll(targets, 1, axis=1), rows)


@pytest.mark.long
@OPTIMISED
def test_stale_messages_in_the_last_pass_are_found_out(monkeypatch):
    """The last pass draws from messages at new points. Densities from before, at points that are gone, bias the evidence."""
    of_pass = Passing.redraw

    def redraw(self, *arguments):
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(passing, "log_messages", stale)
            return of_pass(self, *arguments)

    monkeypatch.setattr(Passing, "redraw", redraw)
    ratio = np.exp(chain_scores(200, 30)[2])
    assert abs(ratio.mean() - 1) > 4 * ratio.std() / len(ratio) ** 0.5


# -- trees and loops, against belief propagation on a grid ------------------------------------------------------------------------------------


@pytest.mark.long
@OPTIMISED
def test_a_tree_with_heavy_tails_has_the_beliefs_of_a_grid():
    built, grid, exact = heavy_tree()
    found = distance(beliefs_at(passed(built, 10, samples=100, iterations=5), built, grid), exact, grid)
    assert found.mean() < 0.05
    assert found.mean(0).max() < 0.09


@pytest.mark.long
@OPTIMISED
@pytest.mark.parametrize(("samples", "most"), [(50, 0.06), pytest.param(150, 0.04, marks=pytest.mark.long)])
def test_on_loops_messages_reach_the_fixed_point_of_the_grid(samples, most):
    """They are not the true marginals: that is belief propagation's own error. With more samples the distance to its fixed point falls."""
    built, grid, exact = lattice()
    assert distance(beliefs_at(passed(built, 5, samples=samples, iterations=10), built, grid), exact, grid).mean() < most


@pytest.mark.long
@OPTIMISED
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
    # The fixed point of loopy belief propagation (test_loops.py).
    np.testing.assert_allclose(narrow, 0.2425, rtol=0.05)


# -- one node, and beliefs with several peaks -------------------------------------------------------------------------------------------------


def mixture_of(means, sd):
    return dist.MixtureSameFamily(
        dist.Categorical(probs=jnp.full(len(means), 1 / len(means))), dist.Normal(jnp.asarray(means), sd).expand([len(means)])
    )


def resampled(means, count, seed):
    """Centres of as many kernels, drawn from the estimate with these ones."""
    rng = np.random.default_rng(seed)
    return list(rng.choice(means, count) + 0.05 * rng.normal(size=count))


@pytest.mark.long
@OPTIMISED
@pytest.mark.parametrize("sizes", [(4, 4), pytest.param((100, 150), marks=pytest.mark.long)])
def test_the_product_of_two_density_estimates(sizes):
    one, other = [0.1, 0.45, 0.55, 0.8], [0.25, 0.35, 0.7, 0.75]
    if sizes != (4, 4):
        one, other = resampled(one, sizes[0], 1), resampled(other, sizes[1], 2)
    width = 0.05 if sizes == (4, 4) else 0.02
    parts = [
        node_factor("one", lambda x: mixture_of(one, width).log_prob(x[0])),
        node_factor("other", lambda x: mixture_of(other, width).log_prob(x[0])),
        proposal("range", dist.Uniform(0.0, 1.0).expand([1]).to_event(1)),
    ]
    found = passed(graph({"x": (1, 1)}, *parts), 10, samples=500, iterations=2, particles=2000)
    grid = np.linspace(0, 1, 4001)
    exact = np.exp(np.asarray(mixture_of(one, width).log_prob(grid) + mixture_of(other, width).log_prob(grid), float))
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
