"""The extended, marginal, tempered and unconstrained views are one text: they agree wherever two of them say the same thing."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.scipy.special import logsumexp

from bayes_body.density.coordinates import Coordinates
from bayes_body.density.density import Density
from bayes_body.density.extended import extended
from bayes_body.density.factor import Factor, Particles, Transition, Variable
from bayes_body.dynamics.diffusion import TruncatedWalk

POSE, BEFORE = Variable("pose"), Variable("pose", -1)
LOW, HIGH = (-1.0, -np.inf), (0.5, np.inf)
SD = (0.6, 0.4)


def _walk(previous):
    return {"pose": TruncatedWalk(previous["pose"], *map(jnp.array, (SD, LOW, HIGH)))}


def _noise(state, scale):
    return {"pose": TruncatedWalk(state["pose"], jnp.array(SD) * scale, *map(jnp.array, (LOW, HIGH)))}


def _skewed(values, data):
    x, y = values[POSE]
    return data * x - jnp.exp(1.5 * x) - 0.5 * (y - x**2) ** 2 / 0.3


def _moved(values, data):
    return -2.0 * jnp.sum((values[POSE] - 0.7 * values[BEFORE]) ** 2)


def _wall(values, data):
    return -0.5 * jnp.maximum(values[POSE][1] - 0.2, 0.0) ** 2 / 0.01


@pytest.fixture
def density():
    """Skewed, off-centre, bounded in one dof and free in the other; one factor reads the frame before. All in double precision."""
    with jax.enable_x64(True):
        yield _density()


def _density():
    previous = Particles({"pose": jnp.array([[0.45, 0.0], [-0.8, 0.5], [0.0, -0.4]])}, jax.nn.log_softmax(jnp.array([0.3, -1.0, 0.8])))
    factors = (
        Factor("skewed", "likelihood", (POSE,), jax.tree_util.Partial(_skewed)),
        Factor("moved", "likelihood", (POSE, BEFORE), jax.tree_util.Partial(_moved)),
        Factor("wall", "constraint", (POSE,), jax.tree_util.Partial(_wall)),
    )
    transition = Transition("walk", jax.tree_util.Partial(_walk), jax.tree_util.Partial(_noise))
    return Density(transition, factors, {"skewed": jnp.array(3.0)}, previous)


def _states(count=50):
    key = jax.random.key(5)
    x = jax.random.uniform(key, (count, 1), minval=-1.0, maxval=0.5)
    return {"pose": jnp.concatenate([x, jax.random.normal(jax.random.fold_in(key, 1), (count, 1))], axis=1)}


def _joint(density, ancestor, state, beta=1.0):
    """ℓ(i, s): log w_i and the log-density after that ancestor."""
    return density.previous.log_weights[ancestor] + density.log_joint(state, density.ancestor(ancestor), beta)[0]


@pytest.mark.parametrize("beta", [1.0, 0.3, 0.0])
def test_the_marginal_view_is_the_sum_of_the_extended(density, beta):
    def gap(state):
        each = jax.vmap(lambda i: _joint(density, i, state, beta))(jnp.arange(3))
        return density.marginal(state, beta) - logsumexp(each)

    assert jnp.abs(jax.jit(jax.vmap(gap))(_states())).max() < 1e-10


def test_ancestor_probabilities_are_those_of_the_extended_view(density):
    def gap(state):
        each = jax.vmap(lambda i: _joint(density, i, state))(jnp.arange(3))
        return density.ancestor_log_probs(state) - jax.nn.log_softmax(each)

    assert jnp.abs(jax.jit(jax.vmap(gap))(_states())).max() < 1e-10


def test_temperature_zero_is_the_constrained_prior(density):
    """The likelihood side says nothing, the constraint holds at full power."""

    def gap(state):
        prior = logsumexp(jax.vmap(lambda w, s: w + density.transition.log_density(state, {"pose": s}))(*_previous(density)))
        return density.marginal(state, 0.0) - prior - _wall({POSE: state["pose"]}, None)

    assert jnp.abs(jax.jit(jax.vmap(gap))(_states())).max() < 1e-10


def test_temperature_zero_silences_an_impossible_likelihood(density):
    silent = Density(density.transition, (Factor("no", "likelihood", (POSE,), jax.tree_util.Partial(_impossible)),), {}, density.previous)
    state = jax.tree.map(lambda leaf: leaf[0], _states())
    assert jnp.isfinite(silent.marginal(state, 0.0))
    assert jnp.all(jnp.isfinite(jax.jit(jax.grad(lambda s: silent.marginal(s, 0.0)))(state)["pose"]))
    assert jnp.isneginf(silent.marginal(state, 0.5))


def _impossible(values, data):
    return -jnp.inf + 0.0 * jnp.sum(values[POSE])


def _previous(density):
    return density.previous.log_weights, density.previous.states["pose"]


def test_both_views_are_exact_on_a_linear_gaussian_model(linear_gaussian):
    """Two weighted ancestors: the posterior is a mixture of two Gaussians with known weights; both views give it, evidence included."""
    with jax.enable_x64(True):
        points, weights = np.array([[0.2, -0.5], [1.5, 0.4]]), np.array([0.3, 0.7])
        y = np.array([0.9])
        d = linear_gaussian.density(y, Particles({"x": jnp.asarray(points)}, jnp.log(jnp.asarray(weights))))
        m = linear_gaussian
        Q, R = m.Q_root @ m.Q_root.T, m.R_sd**2 * np.eye(1)
        S = m.H @ Q @ m.H.T + R
        evidence = np.array([np.exp(-0.5 * (r := y - m.H @ m.A @ p) @ np.linalg.inv(S) @ r) / np.sqrt(np.linalg.det(2 * np.pi * S)) for p in points])
        x = np.array([0.6, -0.1])
        gain = Q @ m.H.T @ np.linalg.inv(S)
        P = Q - gain @ S @ gain.T
        each = []
        for p in points:
            mean = m.A @ p + gain @ (y - m.H @ m.A @ p)
            each.append(np.exp(-0.5 * (x - mean) @ np.linalg.inv(P) @ (x - mean)) / np.sqrt(np.linalg.det(2 * np.pi * P)))
        joint = np.log(weights * evidence * np.array(each))
        state = {"x": jnp.asarray(x)}
        assert np.allclose([_joint(d, i, state) for i in (0, 1)], joint, atol=1e-10)
        assert np.isclose(d.marginal(state), np.logaddexp(*joint), atol=1e-10)
        assert np.allclose(d.ancestor_log_probs(state), joint - np.logaddexp(*joint), atol=1e-10)


def _masses(density, log_determinant):
    """∫ exp ℓ over the state, and over the unconstrained coordinates, on grids."""
    y = jnp.linspace(-4.0, 4.0, 401)
    s = -1.0 + 1.5 * (jnp.arange(600) + 0.5) / 600
    x = jnp.linspace(-14.0, 14.0, 1601)
    grid = lambda a: jnp.stack(jnp.meshgrid(a, y, indexing="ij"), axis=-1).reshape(-1, 2)  # noqa: E731
    over_state = jnp.sum(jnp.exp(jax.jit(jax.vmap(lambda p: density({"pose": p})))(grid(s)))) * (1.5 / 600) * (y[1] - y[0])
    view = density.unconstrained()
    over_x = jax.jit(jax.vmap(lambda p: density(view.constrain({"pose": p})) + log_determinant(view.coordinates, {"pose": p})))(grid(x))
    return over_state, jnp.sum(jnp.exp(over_x)) * (x[1] - x[0]) * (y[1] - y[0])


def test_unconstrained_coordinates_carry_the_same_mass(density):
    over_state, over_x = _masses(density, Coordinates.log_determinant)
    assert abs(over_x / over_state - 1) < 1e-4


def test_a_dropped_jacobian_is_found_out(density):
    over_state, over_x = _masses(density, lambda coordinates, position: 0.0)
    assert abs(over_x / over_state - 1) > 0.1


def test_unconstrained_round_trip(density):
    view = density.unconstrained()
    state = jax.tree.map(lambda leaf: leaf[3], _states())
    back = view.constrain(view.unconstrain(state))
    assert jnp.allclose(back["pose"], state["pose"], atol=1e-5)
    position = view.unconstrain(state)
    assert jnp.isclose(view(position), density(state) + view.coordinates.log_determinant(position), rtol=1e-4)


@pytest.mark.parametrize("beta", [1.0, 0.3, 0.0])
def test_the_extended_view_is_the_log_density_after_an_ancestor_with_the_jacobian(density, beta):
    view, state = extended(density), jax.tree.map(lambda leaf: leaf[3], _states())
    position, ancestor = view.coordinates.unconstrain(state), jnp.array(2)
    log_density, (log_likelihood, _) = view.log_density(ancestor, position, beta)
    expected = _joint(density, 2, state, beta) - density.previous.log_weights[2] + density.unconstrained().coordinates.log_determinant(position)
    assert jnp.isclose(log_density, expected, rtol=1e-6)
    assert jnp.isclose(log_likelihood, density.log_likelihood(state, density.ancestor(2)), rtol=1e-6)
    assert jnp.isclose(view.terms(ancestor, position).likelihood, log_likelihood, rtol=1e-6)
    assert jnp.allclose(view.state(ancestor, position)["pose"], state["pose"], atol=1e-6)


def test_a_completed_draw_takes_its_ancestor_from_their_posterior(density):
    view, state = density.unconstrained(), jax.tree.map(lambda leaf: leaf[3], _states())
    position, count = view.unconstrain(state), 4000
    states, ancestors = jax.jit(jax.vmap(lambda key: view.complete(key, position)))(jax.random.split(jax.random.key(2), count))
    shares, exact = np.bincount(ancestors, minlength=3) / count, np.exp(density.ancestor_log_probs(state))
    assert (np.abs(shares - exact) < 4 * np.sqrt(exact * (1 - exact) / count) + 1e-12).all()
    assert jnp.allclose(states["pose"], state["pose"], atol=1e-6)


def test_parts_add_up(density):
    state = jax.tree.map(lambda leaf: leaf[2], _states())
    before = density.ancestor(jnp.array(1))
    parts = density.parts(state, before)
    assert set(parts) == {"transition", "skewed", "moved", "wall"}
    assert jnp.isclose(sum(parts.values()), density.log_joint(state, before)[0], rtol=1e-5)


def test_new_data_and_particles_do_not_retrace(density):
    traces = []

    @jax.jit
    def value(d, state):
        traces.append(1)
        return d(state)

    state = jax.tree.map(lambda leaf: leaf[0], _states())
    first = value(density, state)
    other = Density(density.transition, density.factors, {"skewed": jnp.array(1.0)}, density.previous)
    assert value(other, state) != first
    assert len(traces) == 1
