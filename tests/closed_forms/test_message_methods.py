"""The published methods as options of particle belief propagation, and damping, against exact answers."""

import jax
import jax.numpy as jnp
import numpy as np
import numpyro.distributions as dist
import pytest
from closed_forms.message_graphs import (
    MODULE,
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
)

from bayes_body.density.graph import Graph
from bayes_body.density.pairwise import edge_factor, graph, node_factor, proposal
from bayes_body.kernels.messages import pampas
from bayes_body.kernels.messages.messages import normalised

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("optimised")]


@pytest.mark.long
@pytest.mark.parametrize("method", ["pbp", "epbp", "pampas"])
def test_a_gaussian_chain_is_exact(method):
    means, variances, evidence, efficiency = chain_scores(200, 30, method=method)
    assert np.sqrt(np.mean(means**2)) < 1.6 and np.abs(means).max() < 4.5
    assert np.sqrt(np.mean(variances**2)) < 1.8
    ratio = np.exp(evidence)
    assert abs(ratio.mean() - 1) < 4 * ratio.std() / len(ratio) ** 0.5
    assert efficiency > 0.3


@pytest.mark.long
@pytest.mark.parametrize("method", ["pbp", "epbp"])
def test_a_tree_with_heavy_tails_has_the_beliefs_of_a_grid(method):
    built, grid, exact = heavy_tree()
    found = distance(beliefs_at(passed(built, 10, samples=100, iterations=5, method=method), built, grid), exact, grid)
    assert found.mean() < 0.05


@pytest.mark.long
def test_strata_come_closer_with_more_particles():
    """But slowly: they are drawn from messages alone."""
    built, grid, exact = heavy_tree()
    few, many = (distance(beliefs_at(passed(built, 4, samples=n, iterations=5, method="pampas"), built, grid), exact, grid).mean() for n in (50, 300))
    assert many < 0.1 and many < 0.8 * few


def shares_of_strata():
    """The weight of each stratum in the messages along a chain, whose nodes have two neighbours at most: three strata, sorted by weight."""
    found = passed(chain(random_walk()), 2, samples=40, iterations=4, method="pampas")
    weights = np.exp(np.concatenate([np.asarray(each, float) for each in found.cavities[0]], axis=1))
    return np.sort(weights.reshape(*weights.shape[:2], 3, -1).sum(axis=-1), axis=-1)


@pytest.mark.long
def test_messages_take_half_of_each_of_their_two_strata_and_forgotten_shares_are_found_out(monkeypatch):
    np.testing.assert_allclose(shares_of_strata(), np.broadcast_to([0.0, 0.5, 0.5], (2, 18, 3)), atol=1e-4)
    monkeypatch.setattr(pampas, "stratified", lambda log_weights, shares: normalised(log_weights))
    assert np.abs(shares_of_strata() - [0.0, 0.5, 0.5]).mean() > 0.1


@pytest.mark.long
@pytest.mark.parametrize("method", ["pbp", "epbp"])
def test_on_loops_messages_reach_the_fixed_point_of_the_grid(method):
    built, grid, exact = lattice()
    found = distance(beliefs_at(passed(built, 5, samples=150, iterations=10, method=method), built, grid), exact, grid)
    assert found.mean() < 0.045


@pytest.mark.long
@pytest.mark.parametrize(
    ("method", "damping"), [("mixture", 0.0), ("epbp", 0.5), *(pytest.param(method, 0.5, marks=pytest.mark.long) for method in ("pbp", "pampas"))]
)
def test_new_data_never_retraces(method, damping):
    sampler, traces = MODULE.build_kernel(samples=20, particles=10, iterations=2, method=method, damping=damping), []

    @jax.jit
    def run(key, graph):
        traces.append(1)
        return sampler.on(key, graph).joint.log_evidence

    for number in range(3):
        assert np.isfinite(run(jax.random.key(number), frustrated(jnp.arange(4.0) * number)))
    assert len(traces) == 1


# -- damping ----------------------------------------------------------------------------------------------------------------------------------

PAIRS, AGAINST, ALONE = [(i, j) for j in range(4) for i in range(j)], 0.5, 2.0
SEEN = jnp.asarray([6.0, 2.0, 4.0, 5.0])


def log_seen(seen, x):
    return log_normal(x[0], seen, ALONE)


def log_opposite(first, second):
    return log_normal((first + second)[0], 0.0, AGAINST)


def draw_opposite(key, parameters, known, reverse):
    del parameters, reverse
    return AGAINST * jax.random.normal(key, known.shape) - known


def frustrated(seen) -> Graph:
    """Four nodes, each of which is to be the opposite of every other: an error changes its sign with every message."""
    return graph(
        {"x": (4, 1)},
        node_factor("seen", log_seen, parameters=seen),
        edge_factor("opposite", log_opposite, PAIRS, draw=draw_opposite),
        proposal("near", lambda seen: dist.Normal(seen, 3.0).expand([1]).to_event(1), parameters=seen),
    )


@pytest.mark.long
def test_damping_ends_an_oscillation():
    """Belief propagation on Gaussian loops has the right means where it converges (Weiss & Freeman 2001)."""
    precision = np.eye(4) / ALONE**2 + (2 * np.eye(4) + np.ones((4, 4))) / AGAINST**2
    mean = np.linalg.solve(precision, np.asarray(SEEN) / ALONE**2)
    jumps, errors = {}, {}
    for damping in (0.0, 0.5):
        found = passed(frustrated(SEEN), 8, samples=300, iterations=12, damping=damping)
        means, variances = moments(found.log_beliefs, found.points)
        errors[damping] = np.abs(means[..., 0] - mean) / np.sqrt(variances[..., 0])
        last = np.asarray(found.rounds.means, float)[:, -3:, :, 0]
        jumps[damping] = np.abs(last[:, 2] - last[:, 1]) / np.sqrt(variances[..., 0])
    # Means of the last rounds, in standard deviations of the belief; about 0.1 of one is the particles' own noise.
    assert jumps[0.0].mean() > 1.0 and errors[0.0].mean() > 1.0
    assert jumps[0.5].mean() < 0.3 and errors[0.5].mean() < 0.3


@pytest.mark.long
def test_damping_has_the_same_fixed_point():
    built, grid, exact = heavy_tree()
    found = distance(beliefs_at(passed(built, 10, samples=100, iterations=8, damping=0.3), built, grid), exact, grid)
    assert found.mean() < 0.05
