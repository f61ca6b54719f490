"""Pairwise graphs from plain functions: what they hold, and what is wrong with them in one sentence."""

import jax
import jax.numpy as jnp
import numpy as np
import numpyro.distributions as dist
import pytest

from bayes_body.base.errors import InputError
from bayes_body.density.pairwise import edge_factor, graph, node_factor, proposal

WIDE = dist.Normal(0.0, 2.0).expand([1]).to_event(1)
STEP = dist.Normal(0.0, 0.5).expand([1]).to_event(1)


def near(seen, x):
    return -0.5 * jnp.sum((x - seen) ** 2)


def test_it_is_the_sum_of_its_factors():
    seen = jnp.asarray([1.0, -1.0, 0.5])
    built = graph(
        {"place": (3, 1), "robot": (1, 1)},
        node_factor("seen", near, range(3), seen),
        node_factor("wide", WIDE),
        edge_factor("step", STEP, [("place_0", "place_1"), (1, 2), ("robot", 2)]),
    )
    assert built.names == ("place_0", "place_1", "place_2", "robot")
    values = jnp.asarray([[0.2], [0.4], [-0.3], [1.0]])
    x = np.asarray(values, float)[:, 0]
    steps = np.array([x[1] - x[0], x[2] - x[1], x[2] - x[3]])
    expected = -0.5 * np.sum((x[:3] - np.asarray(seen)) ** 2)
    expected += np.sum(-0.5 * (x / 2) ** 2 - np.log(2 * np.sqrt(2 * np.pi))) + np.sum(-0.5 * (steps / 0.5) ** 2 - np.log(0.5 * np.sqrt(2 * np.pi)))
    np.testing.assert_allclose(jax.jit(built.log_density)(values), expected, rtol=1e-5)


def test_distributions_of_rows_propose_for_their_own_nodes():
    places = jnp.asarray([-5.0, 5.0])
    built = graph(
        {"x": (3, 1)},
        proposal("near", lambda place: dist.Normal(place, 0.1).expand([1]).to_event(1), [0, 2], places),
        edge_factor("step", STEP, [(0, 1), (1, 2)]),
    )
    (mixture,) = built.proposals
    assert list(np.asarray(mixture.exists)) == [True, False, True]
    drawn, log_probs = jax.jit(lambda key: (mixture.sample(key, 50), mixture.log_prob(jnp.zeros((3, 4, 1)))))(jax.random.key(0))
    drawn = np.asarray(drawn)
    assert abs(drawn[0].mean() + 5) < 0.1 and abs(drawn[2].mean() - 5) < 0.1
    assert np.all(np.isneginf(np.asarray(log_probs)[1]))


def test_a_forest_leaves_out_what_would_close_a_loop():
    built = graph({"x": (4, 1)}, node_factor("wide", WIDE), edge_factor("step", STEP, [(0, 1), (1, 2), (2, 0), (2, 3)]))
    assert built.forest() == ((0, 0), (0, 1), (0, 3))


def test_pieces_are_said():
    with pytest.warns(UserWarning, match="falls into 2 pieces"):
        graph({"x": (3, 1)}, node_factor("wide", WIDE), edge_factor("step", STEP, [(0, 1)]))


NODES = {"x": (3, 1)}
WRONG = {
    "unknown node": ([node_factor("wide", WIDE), edge_factor("step", STEP, [("x_0", "y")])], "factor 'step': reads the node 'y'"),
    "number too large": ([node_factor("wide", WIDE), edge_factor("step", STEP, [(0, 3)])], "factor 'step': reads the node 3"),
    "itself": ([node_factor("wide", WIDE), edge_factor("step", STEP, [(1, 1)])], "an edge from 'x_1' to itself"),
    "three nodes": ([node_factor("wide", WIDE), edge_factor("step", lambda a, b, c: 0.0, [(0, 1, 2)])], "reads 3 nodes at once"),
    "nothing proposes": ([node_factor("seen", near, None, jnp.zeros(3))], "nothing proposes values for the node 'x_0'"),
    "not reached": (
        [node_factor("wide", WIDE, [0]), edge_factor("pull", lambda a, b: -jnp.sum((a - b) ** 2), [(0, 1), (1, 2)])],
        "nothing proposes values for the node 'x_1'",
    ),
    "NaN": (
        [node_factor("wide", WIDE), edge_factor("root", lambda a, b: jnp.sqrt(-1 - jnp.sum((a - b) ** 2)), [(0, 1), (1, 2)])],
        "factor 'root': its log-potential at 'x_0' and 'x_1' is NaN",
    ),
    "an array": ([node_factor("wide", WIDE), node_factor("each", lambda x: -(x**2))], "factor 'each': returns an array of shape (1,)"),
}


@pytest.mark.parametrize("fault", WRONG)
def test_what_is_wrong_is_said(fault):
    parts, sentence = WRONG[fault]
    with pytest.raises(InputError) as raised:
        graph(NODES, *parts)
    assert sentence in str(raised.value)


def test_nodes_have_one_shape():
    with pytest.raises(InputError, match=r"nodes of different shapes: x \(3, 1\), y \(1, 2\)"):
        graph({"x": (3, 1), "y": (1, 2)}, node_factor("wide", WIDE))


def test_a_batch_of_distributions_is_refused():
    with pytest.raises(InputError, match=r"a distribution with batch shape \(3,\); expected one distribution"):
        node_factor("wide", dist.Normal(jnp.zeros(3), 1.0))
