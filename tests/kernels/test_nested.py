"""Nested draws of a tree of normal variables: the evidence of every limb is exact on average, and drawn limbs are those of the posterior."""

import jax
import jax.numpy as jnp
import numpy as np
import numpyro.distributions as dist
import pytest

import bayes_body as bb
from bayes_body.kernels.messages.nested import nested_draws, tree_of, trunk_draws

# Node 0 is the root, 1 branches into two limbs of two nodes, 6 is a limb of its own; the last edge points to its inner node.
EDGES = [(0, 1), (1, 2), (2, 3), (1, 4), (4, 5), (6, 0)]
MOVE, NOISE = 0.5, 0.7
SEEN = np.array([0.2, -0.4, 1.5, 2.0, -1.0, -0.5, 0.8])


@pytest.fixture(scope="module")
def tree_graph():
    step = dist.Normal(0.0, MOVE).expand([1]).to_event(1)
    seen = bb.node_factor("seen", lambda one, x: dist.Normal(x, NOISE).log_prob(one).sum(), parameters=jnp.asarray(SEEN, jnp.float32)[:, None])
    somewhere = bb.proposal("start", dist.Normal(0.0, 1.0).expand([1]).to_event(1))
    return bb.graph({"x": (7, 1)}, seen, bb.edge_factor("step", step, EDGES), somewhere)


def test_trunk_and_limbs(tree_graph):
    tree = tree_of(tree_graph)
    assert [edge.child for edge in tree.trunk] == [1]
    assert sorted([edge.child for edge in limb] for limb in tree.limbs) == [[2, 3], [4, 5], [6]]
    assert [limb[0].reverse for limb in tree.limbs if limb[0].child == 6] == [True]


def test_estimates_are_unbiased_and_draws_are_of_the_posterior(tree_graph):
    tree, count = tree_of(tree_graph), 4000
    trunks = jnp.broadcast_to(jnp.array([0.0, 0.3])[:, None], (count, 16, 2, 1))
    draw = jax.jit(lambda key, graph, shared: nested_draws(key, graph, tree, trunks, shared=shared))
    drawn = draw(jax.random.key(1), tree_graph, True)

    # Given the trunk, what is seen of a limb is normal.
    def log_normal(seen, mean, covariance):
        away = seen - mean
        return -0.5 * (away @ np.linalg.solve(covariance, away) + np.linalg.slogdet(covariance)[1] + len(seen) * np.log(2 * np.pi))

    chain = MOVE**2 * np.array([[1.0, 1.0], [1.0, 2.0]])
    exact = sum(log_normal(SEEN[own], 0.3, chain + NOISE**2 * np.eye(2)) for own in ([2, 3], [4, 5]))
    exact += log_normal(SEEN[6:], 0.0, (MOVE**2 + NOISE**2) * np.eye(1))
    ratios = np.exp(np.asarray(drawn.log_estimates[:, 0], float) - exact)
    assert abs(ratios.mean() - 1) < 4 * ratios.std() / count**0.5
    # With a limb each, the estimates are unbiased too: all trunks are equal here.
    alone = np.exp(np.asarray(draw(jax.random.key(3), tree_graph, False).log_estimates, float) - exact).ravel()
    assert abs(alone.mean() - 1) < 4 * alone.std() / alone.size**0.5 and alone.std() > 2 * ratios.std()
    # The draws, weighted with their estimates, are those of the posterior.
    gain = chain @ np.linalg.inv(chain + NOISE**2 * np.eye(2))
    weights, values = ratios / ratios.sum(), np.asarray(drawn.values, float)[:, :, 0]
    for own in ([2, 3], [4, 5]):
        mean, covariance = 0.3 + gain @ (SEEN[own] - 0.3), chain - gain @ chain
        away = weights @ values[:, own] - mean
        ess = 1 / np.sum(weights**2)
        assert np.all(np.abs(away) < 4 * np.sqrt(np.diagonal(covariance) / ess))
        spread = weights @ (values[:, own] - mean) ** 2 / np.diagonal(covariance)
        assert np.all(np.abs(spread - 1) < 4 * np.sqrt(2 / ess))
    assert np.all(values[:, 0] == 0) and np.all(values[:, 1] == np.float32(0.3))


def test_the_trunk_is_drawn_along_its_edges(tree_graph):
    tree, count = tree_of(tree_graph), 4000
    roots = jnp.full((count, 1), 2.0)
    trunks = jax.jit(lambda key, graph: trunk_draws(key, graph, tree, roots))(jax.random.key(2), tree_graph)
    values = np.asarray(trunks.values, float)
    assert np.all(values[:, 0] == 2.0)
    assert abs(values[:, 1].mean() - 2) < 4 * MOVE / count**0.5 and abs(values[:, 1].std() / MOVE - 1) < 4 * (0.5 / count) ** 0.5


def test_what_is_no_tree_of_densities_is_refused(tree_graph):
    step = dist.Normal(0.0, 1.0).expand([1]).to_event(1)
    with pytest.raises(bb.InputError, match="expected one tree"):
        tree_of(bb.graph({"x": (3, 1)}, bb.node_factor("own", step), bb.edge_factor("step", step, [(0, 1)])))
    with pytest.raises(bb.InputError, match="not a density to draw from"):
        tree_of(bb.graph({"x": (2, 1)}, bb.node_factor("own", step), bb.edge_factor("near", lambda x, y: -jnp.sum((x - y) ** 2), [(0, 1)])))
