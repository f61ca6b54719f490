"""The motion prior by an activity: a normalised mixture of emissions with a filtered belief, and the paper's proposal of an annealing layer."""

import dataclasses
import functools
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.special import softmax
from scipy.stats import multivariate_normal

from bayes_body.base.errors import InputError
from bayes_body.density.coordinates import coordinates_of
from bayes_body.model.body.build import Shape, build_body
from bayes_body.model.body.kinematics import marker_positions
from bayes_body.model.definition import load_body
from bayes_body.model.dynamics.activity import Activity, load_activity, save_activity
from bayes_body.model.dynamics.activity_hmm import Options, build

FPS, STATES, FEATURES = 60.0, 5, 2


@pytest.fixture(autouse=True, scope="module")
def double_precision():
    with jax.enable_x64(True):
        yield


# One program of each for all priors of a form.
_derived = jax.jit(lambda prior, state: prior.with_derived(state))
_conditional = jax.jit(lambda prior, state: prior.conditional(state))
_sampled = jax.jit(lambda prior, key, state: prior.sample(key, state))
_explored = jax.jit(lambda prior, key, state, scale: prior.explore(key, state, state, scale))


@functools.cache
def _body(name="person_31"):
    return build_body(name, load_body(name), Shape(1.75))


@pytest.fixture(scope="module")
def activity():
    """A cycle of five states in a plane, of two people."""
    rng, body = np.random.default_rng(0), _body()
    names = tuple(name for name in body.dof_names[6:] if not name.startswith("head"))
    basis = np.linalg.qr(rng.normal(size=(len(names), FEATURES)))[0]
    angle = 2 * np.pi * np.arange(STATES) / STATES
    transition = 0.7 * np.eye(STATES) + 0.25 * np.roll(np.eye(STATES), 1, axis=1) + 0.05 / STATES
    transition /= transition.sum(axis=1, keepdims=True)
    roots = 0.05 * np.eye(FEATURES) + 0.01 * rng.normal(size=(STATES, FEATURES, FEATURES))
    # Knees and elbows are bent, so that no limit is near.
    means = np.where([name.endswith(("knee", "elbow")) for name in names], -1.0, 0.0) + 0.05 * rng.normal(size=(2, len(names)))
    dofs = len(names)
    return Activity(
        body="person_31", names=names, subjects=("a", "b"), labels=("walk",) * 3 + ("run",) * 2, means=means, between=means.std(axis=0),
        centre=0.01 * rng.normal(size=dofs), basis=basis, residual=np.full(dofs, 0.03), initial=np.full(STATES, 1 / STATES), transition=transition,
        locations=0.5 * np.stack([np.cos(angle), np.sin(angle)], axis=1), covariances=roots @ np.swapaxes(roots, 1, 2),
        change=np.full(len(body.dof_names), 0.02), low=np.full(dofs, -1.0), high=np.full(dofs, 1.0), kept=0.92, fps=FPS,
    )  # fmt: skip


@pytest.fixture(scope="module")
def path(activity, tmp_path_factory):
    where = tmp_path_factory.mktemp("activity") / "cycle.npz"
    save_activity(activity, where)
    return where


def _prior(path, fps=FPS, **options):
    return build(Options(activity=str(path), **options), _body(), fps)


def _state(prior, activity, active=1):
    """A state near the location of a hidden state, with a residual where there is one."""
    rng, begun = np.random.default_rng(0), prior.begin({"pose": jnp.zeros(len(_body().dof_names)).at[2].set(0.9)})
    features = jnp.asarray(activity.locations[active] + 0.02)
    state = begun | {"features": features, "position": jnp.asarray([0.3, -0.2, 0.9]), "orientation": jnp.asarray([0.4, 0.05, -0.03])}
    if "residual" in state:
        state["residual"] = jnp.asarray(0.03 * rng.normal(size=len(activity.names)))
    state["belief"] = jnp.asarray(softmax(_emitted(activity, features)))
    return _derived(prior, state)


def _emitted(activity, features):
    """log N(f; μ, Σ) of each hidden state."""
    return np.array([multivariate_normal.logpdf(features, *moments) for moments in _states(activity)])


def test_a_first_pose_is_kept_and_its_state_is_believed(path, activity):
    """Angles that no marker shows may change; the markers do not, but for the pull of what the activity expects."""
    prior, body = _prior(path), _body()
    pose = np.zeros(len(body.dof_names))
    pose[:6] = (0.3, -0.2, 0.9, 0.4, 0.05, -0.03)
    learned = [body.dof_names.index(name) for name in activity.names]
    pose[learned] = activity.means.mean(axis=0) + activity.centre + activity.basis @ activity.locations[1]
    state = prior.begin({"pose": jnp.asarray(pose)})
    places = jax.jit(jax.vmap(lambda pose: marker_positions(body.skeleton, body.markers, pose)))(np.stack([pose, state["pose"]]))
    assert np.abs(np.diff(places, axis=0)).max() < 0.003
    assert np.allclose(state["belief"], softmax(_emitted(activity, state["features"])), atol=1e-4)


def test_a_first_pose_unlike_the_activity_leaves_features_that_are_likely(path, activity):
    """What the states do not explain is residual, by Bayes' rule for a Gaussian."""
    body, given = _body(), activity.basis @ activity.locations[2] + 0.3 * np.random.default_rng(2).normal(size=len(activity.names))
    pose = np.zeros(len(body.dof_names))
    pose[2] = 0.9
    pose[[body.dof_names.index(name) for name in activity.names]] = activity.means.mean(axis=0) + activity.centre + given
    pose = jnp.asarray(pose)
    state = _prior(path).begin({"pose": pose})
    # Angles that no marker shows may have changed.
    away = np.asarray(activity.basis @ state["features"] + state["residual"])
    spread = np.diag(activity.residual**2 + activity.between**2)
    explained = [multivariate_normal.logpdf(away, activity.basis @ m, activity.basis @ S @ activity.basis.T + spread) for m, S in _states(activity)]
    m, S = _states(activity)[int(np.argmax(explained))]
    precision = np.linalg.inv(S) + activity.basis.T @ np.linalg.inv(spread) @ activity.basis
    expected = np.linalg.solve(precision, np.linalg.inv(S) @ m + activity.basis.T @ np.linalg.inv(spread) @ away)
    assert np.allclose(state["features"], expected, atol=1e-3)


@pytest.mark.slow
@pytest.mark.parametrize("residual", [False, True])
def test_a_first_pose_is_begun_where_its_markers_are(path, activity, residual):
    """A pelvis that is turned by 25 degrees, with thighs and thorax that turn back, is an error of who placed its markers."""
    body, names = _body(), _body().dof_names
    pose = np.zeros(len(names))
    pose[:6] = (0.3, -0.2, 0.9, 0.4, 0.0, 0.0)
    pose[[names.index(name) for name in activity.names]] = activity.means.mean(axis=0) + activity.centre + activity.basis @ activity.locations[1]
    turned = pose.copy()
    turned[names.index("root_yaw")] += np.radians(25)
    for name in ("l_hip_z", "r_hip_z", "thorax_z"):
        turned[names.index(name)] -= np.radians(25)
    state = _prior(path, residual=residual).begin({"pose": jnp.asarray(turned)})
    places = jax.jit(jax.vmap(lambda pose: marker_positions(body.skeleton, body.markers, pose)))(np.stack([turned, state["pose"]]))
    assert np.linalg.norm(np.diff(places, axis=0), axis=-1).mean() < 0.03
    assert abs(np.degrees(float(state["orientation"][0]) - 0.4)) < 8


def test_the_step_before_a_first_pose_is_unknown(path, activity):
    """Its standard deviation is half the largest change in training; a position that forgets its step has none."""
    prior = _prior(path, momentum=0.75, position_sd_m=0.001)
    state = _state(prior, activity)
    before = prior.first(state)["position_before"]
    assert np.allclose(before.mean, state["position"]) and np.allclose(np.sqrt(before.variance), 0.02)
    assert _prior(path).first is None


def _states(activity):
    return list(zip(activity.locations, activity.covariances, strict=True))


def test_the_features_are_a_mixture_over_the_states_that_follow(path, activity):
    """Against the formula, written out; the belief is Bayes' rule over the states."""
    prior = _prior(path)
    state, saved = _state(prior, activity), load_activity(path)
    A = saved.transition / saved.transition.sum(axis=1, keepdims=True)
    f = saved.locations[2] + 0.03
    joint = np.asarray(state["belief"]) @ A * np.exp(_emitted(saved, f))

    @jax.jit
    def program(prior, state, f):
        after = prior.state(state, {**prior.sample(jax.random.key(0), state), "features": f})
        return prior.conditional(state)["features"].log_prob(f), after

    log_density, after = program(prior, state, jnp.asarray(f))
    assert float(log_density) == pytest.approx(math.log(joint.sum()), abs=1e-6)
    assert np.allclose(after["belief"], joint / joint.sum(), atol=1e-6)
    assert np.array_equal(after["position_before"], state["position"])


def test_log_density_is_that_of_its_draws(path, activity):
    """Importance weights of draws with other noise have the mean 1, so the normalisers are right; the features' mean is that of the mixture."""
    prior = _prior(path, residual=False)
    state = _state(prior, activity)
    wide = _prior(path, residual=False, position_sd_m=0.03, orientation_sd_deg=1.6, head_sd_deg=1.6)

    @jax.jit
    def program(prior, wide, state, key):
        draws = jax.vmap(lambda key: wide.sample(key, state))(jax.random.split(key, 4000))
        return draws, jax.vmap(lambda draw: prior.log_density(draw, state) - wide.log_density(draw, state))(draws)

    draws, log_ratio = program(prior, wide, state, jax.random.key(3))
    ratio = np.exp(np.asarray(log_ratio))
    assert abs(ratio.mean() - 1) < 4 * ratio.std() / np.sqrt(len(ratio))
    features = np.asarray(draws["features"])
    ahead = np.asarray(state["belief"]) @ activity.transition
    assert np.allclose(features.mean(axis=0), ahead @ activity.locations, atol=4 * features.std() / np.sqrt(len(features)))


def test_residuals_have_the_learned_spread_and_a_known_subject_has_their_own_mean(path, activity):
    for subject, spread in ((None, np.hypot(activity.residual, activity.between)), ("b", activity.residual)):
        prior = _prior(path, subject=subject, residual_s=0.5)
        state = _state(prior, activity)
        noise = _conditional(prior, state)["residual"]
        kept = math.exp(-1 / (FPS * 0.5))
        assert np.allclose(noise.variance / (1 - kept**2), spread**2, rtol=1e-4)
        assert np.allclose(noise.mean, kept * np.asarray(state["residual"]))
        mean = activity.means[1] if subject else activity.means.mean(axis=0)
        learned = np.array([_body().dof_names.index(name) for name in activity.names])
        rebuilt = mean + activity.centre + activity.basis @ np.asarray(state["features"]) + np.asarray(state["residual"])
        assert np.allclose(np.asarray(state["pose"])[learned], rebuilt, atol=1e-6)


@pytest.mark.parametrize(("temperature", "scale"), [pytest.param(0.0, 1.0, marks=pytest.mark.slow), (0.6, 1.0), (0.6, 0.25)])
def test_a_layer_makes_the_transitions_of_the_paper(path, activity, temperature, scale):
    """Frequencies of the state that is reached, against powers of the matrix; K by (12)."""
    prior = _prior(path, temperature=temperature, residual=False)
    state = _state(prior, activity)
    start, stays = 1, activity.transition[1, 1]
    needed = max(1, math.ceil(math.log(1 - temperature * scale) / math.log(stays)))
    assert needed == {(0.0, 1.0): 1, (0.6, 1.0): 3, (0.6, 0.25): 1}[temperature, scale]
    count = 4000
    keys = jax.random.split(jax.random.key(1), count)
    found = jax.jit(jax.vmap(_explored, (None, 0, None, None)))(prior, keys, state, jnp.asarray(scale))
    expected = np.linalg.matrix_power(activity.transition, needed)[start]
    moved = np.asarray(found["position"]) - np.asarray(state["position"])
    assert np.allclose(moved.std(axis=0), 0.02 * scale, rtol=0.06)
    features = np.asarray(found["features"])
    reached = np.argmin(np.linalg.norm(features[:, None] - activity.locations, axis=-1), axis=1)
    rates = np.bincount(reached, minlength=STATES) / count
    assert np.abs(rates - expected).max() < 0.03
    # In a refinement layer, a state that did not change keeps the particle's own features.
    kept = features[reached == start].mean(axis=0)
    around = np.asarray(state["features"]) if scale < 1 else activity.locations[start]
    assert np.allclose(kept, around, atol=0.01)
    spread = np.cov(features[reached == start].T)
    assert np.allclose(spread, scale * activity.covariances[start], atol=0.15 * scale * activity.covariances[start].max())


def test_the_first_layer_keeps_a_share_of_the_step(path, activity):
    """Later layers start from a position that has made it."""
    plain, keeping = _prior(path), _prior(path, momentum=0.75)
    state = _state(plain, activity)
    state["position_before"] = jnp.asarray(np.asarray(state["position"]) - np.array([0.02, -0.01, 0.004]))
    for scale, share in ((1.0, 0.75), (0.5, 0.0)):
        ways = [np.asarray(_explored(prior, jax.random.key(0), state, jnp.asarray(scale))["position"]) for prior in (plain, keeping)]
        assert np.allclose(ways[1] - ways[0], share * np.array([0.02, -0.01, 0.004]), atol=1e-6)


def test_the_step_aside_is_kept_less(path, activity):
    """Along the direction in which the pelvis faces the position keeps its usual share, also of the step upwards."""
    prior = _prior(path, momentum=0.9, momentum_aside=0.2)
    state = _state(prior, activity)
    yaw = float(state["orientation"][0])
    ahead, aside, up = np.array([math.cos(yaw), math.sin(yaw), 0]), np.array([-math.sin(yaw), math.cos(yaw), 0]), np.array([0, 0, 1.0])
    state["position_before"] = state["position"] - jnp.asarray(0.02 * ahead - 0.01 * aside + 0.004 * up)
    kept = np.asarray(_conditional(prior, state)["position"].mean) - np.asarray(state["position"])
    assert np.allclose(kept, 0.9 * (0.02 * ahead + 0.004 * up) - 0.2 * 0.01 * aside, atol=1e-6)


def test_a_layer_of_an_annealing_kernel_explores(path, activity):
    prior = _prior(path)
    state = _state(prior, activity)
    key, scale = jax.random.key(0), jnp.asarray(0.5)
    explored = _explored(prior, key, state, scale)
    perturbed, entered = jax.jit(lambda key: (prior.perturb(key, state, state, scale), prior.enter(key, state)))(key)
    assert np.array_equal(perturbed["features"], explored["features"]) and set(perturbed) == set(entered) == set(state)
    assert np.array_equal(entered["features"], _explored(prior, key, state, jnp.asarray(1.0))["features"])


def test_a_session_of_half_the_rate_takes_two_steps_at_once(path, activity):
    once, twice = _prior(path), _prior(path, fps=30.0)
    state = _state(once, activity)
    expected = np.asarray(state["belief"]) @ np.linalg.matrix_power(activity.transition, 2)
    slow, fast = (_conditional(prior, state) for prior in (twice, once))
    assert np.allclose(slow["features"].mixing_distribution.probs, expected, atol=1e-6)
    assert np.allclose(slow["position"].variance, 2 * np.asarray(fast["position"].variance))
    with pytest.raises(InputError, match="learned at 60 frames per second, and the session has 50"):
        _prior(path, fps=50.0)


@pytest.mark.slow
def test_gradients_reach_every_sampled_variable(path, activity):
    """Of the density of the second of two frames, which depends on the features of the first through the belief."""
    prior = _prior(path, momentum=0.5)
    state = _state(prior, activity)
    between = _sampled(prior, jax.random.key(1), state)
    later = _sampled(prior, jax.random.key(2), between)
    coordinates = coordinates_of(prior.conditional(state))
    position = jax.jit(coordinates.unconstrain)(between)

    @jax.jit
    @jax.value_and_grad
    def density(position):
        middle = prior.state(state, coordinates.constrain(position))
        return prior.log_density(middle, state) + prior.log_density(later, middle)

    for name, values in density(position)[1].items():
        at = int(np.abs(values).argmax())
        step = 1e-6 * np.eye(len(values))[at]
        plus, minus = (float(density(position | {name: np.asarray(position[name]) + sign * step})[0]) for sign in (1, -1))
        assert float(values[at]) == pytest.approx((plus - minus) / 2e-6, rel=1e-4)


def test_what_does_not_belong_together_is_a_sentence(path, activity, tmp_path):
    with pytest.raises(InputError, match="'c' is not among its people"):
        _prior(path, subject="c")
    other = tmp_path / "other.npz"
    save_activity(dataclasses.replace(activity, names=("tail", *activity.names[1:])), other)
    with pytest.raises(InputError, match="learned on the body 'person_31'; the model's body 'person_31' has other dofs, without tail"):
        _prior(other)
    for change in ({"transition": activity.transition + 0.1}, {"covariances": -activity.covariances}, {"fps": 0.0}):
        save_activity(dataclasses.replace(activity, **change), other)
        with pytest.raises(InputError, match="learn activity-hmm"):
            load_activity(other)
    with pytest.raises(InputError, match="no such file"):
        load_activity(tmp_path / "none.npz")
