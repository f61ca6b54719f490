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
from bayes_body.model.dynamics.diffusion import TruncatedWalk

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
    rng = np.random.default_rng(5)
    return {"pose": jnp.asarray(np.stack([rng.uniform(-1.0, 0.5, count), rng.normal(size=count)], axis=1))}


def _one_state(number):
    return {"pose": jnp.asarray(np.asarray(_states()["pose"])[number])}


def _joint(density, ancestor, state, beta=1.0):
    """ℓ(i, s): log w_i and the log-density after that ancestor."""
    return density.previous.log_weights[ancestor] + density.log_joint(state, density.ancestor(ancestor), beta)[0]


@pytest.mark.parametrize("beta", [1.0, 0.3, 0.0])
def test_the_marginal_view_is_the_sum_of_the_extended(density, beta):
    def gap(state):
        each = jax.vmap(lambda i: _joint(density, i, state, beta))(jnp.arange(3))
        return density.marginal(state, beta) - logsumexp(each)

    assert np.abs(jax.jit(jax.vmap(gap))(_states())).max() < 1e-10


def test_ancestor_probabilities_are_those_of_the_extended_view(density):
    def gap(state):
        each = jax.vmap(lambda i: _joint(density, i, state))(jnp.arange(3))
        return density.ancestor_log_probs(state) - jax.nn.log_softmax(each)

    assert np.abs(jax.jit(jax.vmap(gap))(_states())).max() < 1e-10


def test_temperature_zero_is_the_constrained_prior(density):
    """The likelihood side says nothing, the constraint holds at full power."""

    def gap(state):
        prior = logsumexp(jax.vmap(lambda w, s: w + density.transition.log_density(state, {"pose": s}))(*_previous(density)))
        return density.marginal(state, 0.0) - prior - _wall({POSE: state["pose"]}, None)

    assert np.abs(jax.jit(jax.vmap(gap))(_states())).max() < 1e-10


def test_temperature_zero_silences_an_impossible_likelihood(density):
    silent = Density(density.transition, (Factor("no", "likelihood", (POSE,), jax.tree_util.Partial(_impossible)),), {}, density.previous)
    state = _one_state(0)
    marginal = jax.jit(jax.value_and_grad(silent.marginal))
    value, gradient = marginal(state, 0.0)
    assert np.isfinite(value) and np.isfinite(gradient["pose"]).all()
    assert np.isneginf(marginal(state, 0.5)[0])


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
        found = jax.jit(lambda d, state: ([_joint(d, i, state) for i in (0, 1)], d.marginal(state), d.ancestor_log_probs(state)))(d, state)
        assert np.allclose(found[0], joint, atol=1e-10)
        assert np.isclose(found[1], np.logaddexp(*joint), atol=1e-10)
        assert np.allclose(found[2], joint - np.logaddexp(*joint), atol=1e-10)


def _masses(density, log_determinant):
    """∫ exp ℓ over the state, and over the unconstrained coordinates, on grids."""
    y = np.linspace(-4.0, 4.0, 401)
    s = -1.0 + 1.5 * (np.arange(600) + 0.5) / 600
    x = np.linspace(-14.0, 14.0, 1601)
    grid = lambda a: np.stack(np.meshgrid(a, y, indexing="ij"), axis=-1).reshape(-1, 2)  # noqa: E731
    over_state = np.sum(np.exp(jax.jit(jax.vmap(lambda p: density({"pose": p})))(grid(s)))) * (1.5 / 600) * (y[1] - y[0])
    view = density.unconstrained()
    over_x = jax.jit(jax.vmap(lambda p: density(view.constrain({"pose": p})) + log_determinant(view.coordinates, {"pose": p})))(grid(x))
    return over_state, np.sum(np.exp(over_x)) * (x[1] - x[0]) * (y[1] - y[0])


def test_unconstrained_coordinates_carry_the_same_mass(density):
    over_state, over_x = _masses(density, Coordinates.log_determinant)
    assert abs(over_x / over_state - 1) < 1e-4


def test_a_dropped_jacobian_is_found_out(density):
    over_state, over_x = _masses(density, lambda coordinates, position: 0.0)
    assert abs(over_x / over_state - 1) > 0.1


def test_unconstrained_round_trip(density):

    @jax.jit
    def program(density, state):
        view = density.unconstrained()
        position = view.unconstrain(state)
        return view.constrain(position)["pose"], view(position), density(state) + view.coordinates.log_determinant(position)

    state = _one_state(3)
    back, value, expected = program(density, state)
    assert np.allclose(back, state["pose"], atol=1e-5)
    assert np.isclose(value, expected, rtol=1e-4)


@pytest.mark.parametrize("beta", [1.0, 0.3, 0.0])
def test_the_extended_view_is_the_log_density_after_an_ancestor_with_the_jacobian(density, beta):
    state = _one_state(3)
    pairs, back = _extended_and_joint(density, state, beta)
    for given, expected in pairs:
        assert np.isclose(given, expected, rtol=1e-6)
    assert np.allclose(back, state["pose"], atol=1e-6)


@jax.jit
def _extended_and_joint(density, state, beta):
    """Pairs of numbers that agree, and the state after its way through the coordinates."""
    view, ancestor = extended(density), jnp.array(2)
    position = view.coordinates.unconstrain(state)
    log_density, (log_likelihood, _) = view.log_density(ancestor, position, beta)
    expected = _joint(density, 2, state, beta) - density.previous.log_weights[2] + density.unconstrained().coordinates.log_determinant(position)
    likelihoods = density.log_likelihood(state, density.ancestor(2)), view.terms(ancestor, position).likelihood
    return ((log_density, expected), *((log_likelihood, other) for other in likelihoods)), view.state(ancestor, position)["pose"]


def test_a_completed_draw_takes_its_ancestor_from_their_posterior(density):
    state, count = _one_state(3), 4000

    @jax.jit
    def program(density, state, key):
        view = density.unconstrained()
        position = view.unconstrain(state)
        return jax.vmap(lambda key: view.complete(key, position))(jax.random.split(key, count)), density.ancestor_log_probs(state)

    (states, ancestors), log_probs = program(density, state, jax.random.key(2))
    shares, exact = np.bincount(ancestors, minlength=3) / count, np.exp(log_probs)
    assert (np.abs(shares - exact) < 4 * np.sqrt(exact * (1 - exact) / count) + 1e-12).all()
    assert np.allclose(states["pose"], state["pose"], atol=1e-6)


def test_parts_add_up(density):
    state = _one_state(2)
    before = density.ancestor(jnp.array(1))
    parts, (log_joint, _) = jax.jit(lambda density: (density.parts(state, before), density.log_joint(state, before)))(density)
    assert set(parts) == {"transition", "skewed", "moved", "wall"}
    assert np.isclose(sum(map(float, parts.values())), log_joint, rtol=1e-5)


def test_new_data_and_particles_do_not_retrace(density):
    traces = []

    @jax.jit
    def value(d, state):
        traces.append(1)
        return d(state)

    state = _one_state(0)
    first = value(density, state)
    other = Density(density.transition, density.factors, {"skewed": jnp.array(1.0)}, density.previous)
    assert value(other, state) != first
    assert len(traces) == 1
