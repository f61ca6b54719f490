"""Diagnostics of message passing: changes and oscillation in closed form, and the parts of the proposal that bring the weight."""

import jax
import jax.numpy as jnp
import numpy as np
import numpyro.distributions as dist
import pytest
from scipy.spatial.transform import Rotation

from bayes_body.density.pairwise import edge_factor, graph, node_factor, proposal
from bayes_body.density.spaces import SE3, circle, euclidean
from bayes_body.kernels.messages.messages import Beliefs, Directed, Summary, belief_sds, changes, message_figures, oscillation, shares_of_weight
from bayes_body.kernels.messages.node_proposals import LEAST, MOST, Shares, adapted_shares, proposals

_changes, _oscillation = (jax.jit(function, static_argnums=0) for function in (changes, oscillation))
LINE = euclidean(("x", "y"), ("m", "m"))
ANGLE = circle(("angle",))
LIMB = SE3("coordinate")


def placed(x: float, turn: float) -> np.ndarray:
    """A limb at x metres, turned about an axis askew."""
    axis = np.array([1.0, 2.0, 2.0]) / 3
    return np.array([x, 0, 0, *Rotation.from_rotvec(turn * axis).as_quat(scalar_first=True)])


def test_a_change_is_a_root_mean_square_in_standard_deviations():
    means = jnp.asarray([[[0.0, 0.0]], [[0.3, 0.0]], [[0.3, 0.8]]])
    sds = jnp.asarray([[[9.0, 9.0]], [[0.1, 0.1]], [[0.1, 0.4]]])
    found = np.asarray(_changes(LINE, means, sds))
    assert np.isnan(found[0]).all()
    np.testing.assert_allclose(found[1:, 0], [3 / 2**0.5, 2 / 2**0.5], rtol=1e-3)


def test_angles_change_the_short_way():
    found = _changes(ANGLE, jnp.asarray([[[3.1]], [[-3.1]]]), jnp.full((2, 1, 1), 0.1))
    np.testing.assert_allclose(found[1, 0], (2 * np.pi - 6.2) / 0.1, rtol=1e-3)


def test_a_turned_limb_changes_by_its_angle():
    means = jnp.asarray([[placed(0.0, 0.2)], [placed(0.0, 0.5)]])
    np.testing.assert_allclose(_changes(LIMB, means, jnp.full((2, 1, 6), 0.1))[1, 0], 3 / 6**0.5, rtol=1e-3)


@pytest.mark.parametrize(("last", "expected"), [(0.0, 2.0), (0.1, 2**0.5), (0.2, 0.0), (0.9, 0.0)])
def test_an_oscillation_is_a_jump_back(last, expected):
    """From 0 to 0.2 and on to `last`, in standard deviations of 0.1; a limb is moved and turned."""
    for space, points, dimension in (
        (LINE, [np.full(2, value) for value in (0.0, 0.2, last)], 2),
        (LIMB, [placed(3**0.5 * value, 3**0.5 * value) for value in (0.0, 0.2, last)], 6),
    ):
        found = _oscillation(space, np.asarray(points, np.float32)[:, None], jnp.full((3, 1, dimension), 0.1))
        np.testing.assert_allclose(found[0], expected, rtol=1e-3, atol=1e-3)


def test_too_few_iterations_have_no_oscillation():
    assert np.isnan(_oscillation(LINE, jnp.zeros((2, 3, 2)), jnp.ones((2, 3, 2)))).all()


def test_an_iteration_of_several_rounds_ends_with_its_last():
    """Rounds 0, 1, 2 and 3, 4, 5 are two iterations."""
    means = jnp.arange(6.0)[:, None, None] * jnp.ones(2)
    rounds = Summary(means, jnp.ones((6, 1, 2)), jnp.arange(6.0)[:, None], jnp.arange(6.0))
    found = jax.jit(message_figures, static_argnums=(0, 2, 3))(LINE, rounds, 2, 50, jnp.asarray(7.0), jnp.ones((1, 4)) / 4)
    np.testing.assert_allclose(found["message_change"][1], 3, rtol=1e-3)
    assert found["belief_sd"].shape == (2, 1, 2) and found["belief_ess"] == 5 and found["message_ess"] == 5
    assert found["samples"] == 50 and found["joint_ess"] == 7


def test_standard_deviations_are_weighted():
    points = jnp.asarray([[[0.0, 0.0], [1.0, 0.0], [50.0, 50.0]]])
    found = jax.jit(belief_sds, static_argnums=0)(LINE, jnp.asarray([[0.25, 0.75, 0.0]]), points, jnp.asarray([[0.75, 0.0]]))
    np.testing.assert_allclose(found, [[(0.25 * 0.75) ** 0.5, 0.0]], rtol=1e-6)


def test_detections_have_the_share_that_they_brought_within_bounds():
    """The first mixture brought much, little, and too much together with the second; the second brought nothing, little, and much."""
    first, brought = jnp.full((3, 2), 0.1), jnp.asarray([[0.5, 0.0], [0.01, 0.05], [0.8, 0.4]])
    expected = [[0.5, LEAST * 0.1], [LEAST * 0.1, 0.05], [MOST * 2 / 3, MOST / 3]]
    np.testing.assert_allclose(adapted_shares(first, brought), expected, rtol=1e-6)


def test_a_node_without_detections_gives_their_share_to_the_others():
    """Of three nodes with messages and particles, the first is detected, the second is not, and the third has no particles yet."""
    built = graph(
        {"x": (3, 1)},
        node_factor("prior", lambda x: -(x[0] ** 2)),
        edge_factor("step", dist.Normal(0.0, 1.0).expand([1]).to_event(1), [(0, 1), (1, 2)]),
        proposal("near", lambda place: dist.Normal(place, 1.0).expand([1]).to_event(1), [0, 2], jnp.asarray([0.0, 1.0])),
    )
    points, zeros, ready = jnp.zeros((3, 4, 1)), jnp.zeros((3, 4)), jnp.asarray([1.0, 1.0, 0.0])
    nothing = Directed(jnp.zeros((2, 4)), jnp.zeros((2, 4)))
    beliefs = Beliefs(points, zeros, zeros, zeros, (nothing,), ready)
    chosen = proposals(built, beliefs, (nothing,), None, Shares(0.3, 0.1, 0.2, 0.6), False)
    # Messages, prior, detections, fit. There is no prior; of the third node's neighbours one has particles.
    others = 1 - 0.2 / 1.2
    expected = [[others / 3, 0, 0.2 / 1.2, others * 2 / 3], [1 / 3, 0, 0, 2 / 3], [others, 0, 0.2 / 1.2, 0]]
    np.testing.assert_allclose(np.exp(chosen.shares), expected, atol=1e-6)


def test_a_share_is_what_a_part_of_the_proposal_brought():
    """Two heavy points, one from the messages alone and one at which both mixtures of detections are equally likely; the light one counts nothing."""
    log_weights = jnp.log(jnp.asarray([[0.6, 0.4, 0.0]]))
    log_parts = jnp.log(jnp.asarray([[[2.0, 0, 0, 0, 0], [0, 0, 0.5, 0.5, 1.0], [0, 9.0, 0, 0, 0]]]))
    np.testing.assert_allclose(jax.jit(shares_of_weight)(log_weights, log_parts), [[0.6, 0.0, 0.2, 0.2]], atol=1e-6)
