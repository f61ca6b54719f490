"""The walking prior: its pose is mean and modes at a phase, its noise is normal, and it says which body it needs."""

import dataclasses
import functools
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from bayes_body.base.errors import InputError
from bayes_body.density.coordinates import coordinates_of
from bayes_body.model.body.build import Shape, build_body
from bayes_body.model.body.kinematics import marker_positions
from bayes_body.model.definition import load_body, load_definition
from bayes_body.model.dynamics.angle_cycle import load_angle_cycle, save_angle_cycle
from bayes_body.model.dynamics.walking_cycle import Options, build

FPS = 60.0


@pytest.fixture(autouse=True, scope="module")
def double_precision():
    with jax.enable_x64(True):
        yield


# One program of each for all priors of a form.
_derived = jax.jit(lambda prior, state: prior.derive(state))
_moments = jax.jit(lambda prior, state: {name: (noise.mean, noise.variance) for name, noise in prior.conditional(state).items()})
_markers = jax.jit(jax.vmap(lambda body, pose: marker_positions(body.skeleton, body.markers, pose), (None, 0)))


def _means(prior, state):
    return {name: mean for name, (mean, _) in _moments(prior, state).items()}


@pytest.fixture(scope="module")
def cycle():
    return load_angle_cycle()


@functools.cache
def _body(height=1.75, name="person_31"):
    return build_body(name, load_body(name), Shape(height))


def _prior(height=1.75, fps=FPS, **options):
    return build(Options(**options), _body(height), fps)


def _state(prior, cycle, seed=0, **changes):
    rng = np.random.default_rng(seed)
    sampled = {
        "coefficients": rng.normal(size=len(cycle.modes)),
        "phase": rng.uniform(size=1),
        "position": np.array([0.3, -0.2, 0.9]),
        "orientation": np.array([0.4, 0.05, -0.03]),
        "heading": np.array([0.3]),
        "residual": 0.05 * rng.normal(size=len(cycle.names)),
    }
    state = {name: jnp.asarray(value) for name, value in (sampled | changes).items()}
    return {name: state[name] for name in jax.eval_shape(prior.perturbation, state, jnp.asarray(1.0))}


def _series(terms, phase):
    """The Fourier series, written out."""
    harmonics = (len(terms) - 1) // 2
    value = terms[0].copy()
    for k in range(1, harmonics + 1):
        value += terms[k] * math.cos(2 * math.pi * k * phase) + terms[harmonics + k] * math.sin(2 * math.pi * k * phase)
    return value


@pytest.mark.parametrize("residual", [True, False])
def test_the_pose_is_mean_and_modes_at_the_phase(cycle, residual):
    prior = _prior(residual=residual)
    state = _state(prior, cycle)
    expected = _series(cycle.mean, float(state["phase"][0]))
    for c, mode in zip(np.asarray(state["coefficients"]), cycle.modes, strict=True):
        expected = expected + c * _series(mode, float(state["phase"][0]))
    expected = expected + np.asarray(state.get("residual", 0.0))
    pose = np.asarray(_derived(prior, state)["pose"])
    assert ("residual" in state) == residual
    assert np.allclose(pose[:3], state["position"]) and np.allclose(pose[3:6], state["orientation"])
    assert np.allclose(pose[6:], expected, atol=1e-5)


def test_a_whole_cycle_later_the_pose_is_the_same(cycle):
    prior = _prior()
    state = _state(prior, cycle)
    pose, later, half = (np.asarray(_derived(prior, state | {"phase": np.asarray(state["phase"]) + away})["pose"]) for away in (0, 3, 0.5))
    assert np.allclose(pose, later, atol=1e-9)
    assert np.abs(pose - half).max() > 0.3


def test_no_pose_leaves_the_limits(cycle):
    prior, body = _prior(), _body()
    pose = np.asarray(_derived(prior, _state(prior, cycle, coefficients=np.full(len(cycle.modes), 30.0)))["pose"])
    low, high = np.asarray(body.skeleton.low), np.asarray(body.skeleton.high)
    assert ((pose >= low) & (pose <= high)).all()
    assert (pose == low).any() or (pose == high).any()


def test_the_mean_walk_is_a_walk(cycle):
    """The left knee bends by 50 to 75 degrees, feet are under the body, left and right alternate, and a standing person's speed is that of people."""
    prior, body = _prior(), _body()
    rest = _state(prior, cycle, coefficients=np.zeros(len(cycle.modes)), residual=np.zeros(len(cycle.names)), orientation=np.zeros(3))
    phases = np.linspace(0, 1, 50, endpoint=False)
    poses = np.asarray(jax.jit(jax.vmap(lambda phase: prior.derive(rest | {"phase": phase[None]})["pose"]))(phases))
    names = list(body.dof_names)
    bend, swing = (np.degrees(np.ptp(poses[:, names.index(name)])) for name in ("l_knee", "l_hip_y"))
    assert 50 < bend < 75 and 30 < swing < 60
    places = np.asarray(_markers(body, poses))
    left, right = (places[:, body.markers.names.index(f"{side}_ankle"), 0] for side in "lr")
    # At phase 0 the left heel strikes, in front of the body; half a cycle later the right one does.
    assert left[0] - right[0] > 0.4 and right[25] - left[25] > 0.4
    moved = _means(prior, rest)
    speed, rate = ((float(moved[name][0]) - float(rest[name][0])) * FPS for name in ("position", "phase"))
    assert 1.0 < speed < 1.7 and 0.7 < rate < 1.1


def test_a_longer_leg_has_slower_and_longer_strides(cycle):
    priors = [_prior(height) for height in (1.5, 1.5 * 1.44)]
    rate, speed = np.array(
        [
            [float(_means(prior, state)[name][0]) - float(state[name][0]) for name in ("phase", "position")]
            for prior in priors
            for state in [_state(prior, cycle, orientation=np.zeros(3))]
        ]
    ).T
    assert rate[0] / rate[1] == pytest.approx(1.2, rel=1e-5)
    assert speed[1] / speed[0] == pytest.approx(1.2, rel=1e-5)


def test_the_step_goes_where_the_body_faces(cycle):
    prior = _prior()
    state = _state(prior, cycle, orientation=np.array([2.0, 0.0, 0.0]))
    step = np.asarray(_means(prior, state)["position"]) - np.asarray(state["position"])
    assert math.atan2(step[1], step[0]) == pytest.approx(2.0) and step[2] == 0


@pytest.mark.slow
def test_a_heading_leads_the_walk_and_the_pelvis_returns_to_it(cycle):
    """Without noise, what separates the pelvis from the heading, and from upright, decays over `upright_s`; its variance becomes stationary."""
    prior = _prior(heading_sd_deg=0.3, upright_s=0.5, orientation_sd_deg=1.0)
    state = _state(prior, cycle)
    means, variances = ({name: np.asarray(moments[k]) for name, moments in _moments(prior, state).items()} for k in (0, 1))
    step = means["position"] - np.asarray(state["position"])
    assert math.atan2(step[1], step[0]) == pytest.approx(0.3)
    kept = math.exp(-1 / (FPS * 0.5))
    assert np.allclose(means["orientation"], [0.3 + kept * 0.1, kept * 0.05, -kept * 0.03])
    assert np.allclose(means["heading"], 0.3) and variances["heading"][0] == pytest.approx(math.radians(0.3) ** 2)
    assert math.degrees(math.sqrt(variances["orientation"][0] / (1 - kept**2))) == pytest.approx(3.9, abs=0.1)
    begun = prior.begin({"pose": _derived(prior, state)["pose"]})
    assert np.allclose(begun["heading"], begun["orientation"][:1])


def test_the_printed_form_does_not_drift(cycle):
    printed = _prior(drift=False, stationary=False, residual=False)
    state = _state(printed, cycle)
    centres = _means(printed, state)
    assert np.array_equal(centres["phase"], state["phase"]) and np.array_equal(centres["coefficients"], state["coefficients"])


@pytest.mark.parametrize("fps", [30.0, 60.0, 120.0])
def test_the_noise_of_a_second_is_the_same_at_every_rate(cycle, fps):
    """Variances after one second, by the recursion of each variable; coefficients tend to standard normal."""
    prior = _prior(fps=fps)
    noise = {name: float(variance[0]) for name, (_, variance) in _moments(prior, _state(prior, cycle)).items()}
    assert noise["phase"] * fps == pytest.approx(60 * 0.006**2)
    assert noise["position"] * fps == pytest.approx(60 * 0.008**2)
    kept = 1 - noise["coefficients"]
    assert kept**fps == pytest.approx((1 - 0.1**2) ** 60, rel=1e-4)
    spread = cycle.residual[0] ** 2
    assert (1 - noise["residual"] / spread) ** fps == pytest.approx(math.exp(-2 / 0.5), rel=1e-4)


def test_log_density_is_that_of_its_draws(cycle):
    """The mean of -log p over draws is the entropy of the normal distributions, which needs the right normalisers."""
    prior = _prior()
    state = _state(prior, cycle)

    @jax.jit
    def program(prior, state, key):
        draws = jax.vmap(lambda key: prior.sample(key, state))(jax.random.split(key, 4000))
        return draws["pose"], jax.vmap(prior.derive)(draws)["pose"], jax.vmap(prior.log_density, (0, None))(draws, state)

    poses, derived, log_densities = program(prior, state, jax.random.key(3))
    values = -np.asarray(log_densities)
    variances = np.concatenate([np.ravel(variance) for _, variance in _moments(prior, state).values()])
    entropy = 0.5 * np.sum(np.log(2 * np.pi * np.e * variances))
    assert abs(values.mean() - entropy) < 4 * values.std() / np.sqrt(len(values))
    assert np.allclose(poses, derived)


def test_gradients_reach_every_sampled_variable(cycle):
    prior, body = _prior(), _body()
    state = _state(prior, cycle)
    coordinates = coordinates_of(prior.conditional(state))
    position = jax.jit(coordinates.unconstrain)(state)

    @jax.jit
    @jax.value_and_grad
    def height_of_wrist(position):
        pose = prior.with_derived(coordinates.constrain(position))["pose"]
        return jnp.sum(marker_positions(body.skeleton, body.markers, pose)[body.markers.names.index("l_wrist")])

    for name, values in height_of_wrist(position)[1].items():
        assert np.abs(values).max() > 0
        at = int(np.abs(values).argmax())
        step = 1e-6 * np.eye(len(values))[at]
        plus, minus = (float(height_of_wrist(position | {name: np.asarray(position[name]) + sign * step})[0]) for sign in (1, -1))
        assert float(values[at]) == pytest.approx((plus - minus) / 2e-6, rel=1e-5)


@pytest.mark.parametrize("phase", [0.1, 0.4, 0.8])
def test_the_first_state_is_near_the_first_pose(cycle, phase):
    """A step after the first state is a pose of the mean cycle, also of the second solution of a shoulder; an odd pose has likely coefficients."""
    prior, body = _prior(), _body()
    zeros = {"coefficients": np.zeros(len(cycle.modes)), "residual": np.zeros(len(cycle.names))}
    state = _state(prior, cycle, phase=np.array([phase]), **zeros)
    pose = np.asarray(_derived(prior, state)["pose"])
    at = np.array([body.dof_names.index(f"l_shoulder_{axis}") for axis in "yxz"])
    other = pose.copy()
    other[at] = np.array([1.0, -1.0, 1.0]) * pose[at] + np.pi
    for first in (pose, other):
        begun = prior.begin({"pose": jnp.asarray(first)})
        ahead = _means(prior, begun)
        assert abs(float(ahead["phase"][0]) - phase) < 0.02 and float(ahead["phase"][0]) > float(begun["phase"][0]) + 0.01
        assert np.abs(np.diff(_markers(body, np.stack([pose, _derived(prior, ahead)["pose"]])), axis=0)).max() < 0.02
    away = 0.3 * np.random.default_rng(1).normal(size=pose.shape)
    away[:6] = 0.0
    begun = prior.begin({"pose": jnp.asarray(pose + away)})
    assert np.abs(begun["coefficients"]).max() < 3


def test_another_body_is_a_sentence(tmp_path, cycle):
    for name in ("poon_fleet_23", "arm_4"):
        with pytest.raises(InputError, match=f"the first joint of the body '{name}' is"):
            build(Options(), _body(name=name), FPS)
    mine = tmp_path / "mine.npz"
    save_angle_cycle(dataclasses.replace(cycle, body="mine", names=("x", *cycle.names[1:])), mine)
    with pytest.raises(InputError, match="learned on the body 'mine', and the model's body 'person_31' has other dofs"):
        build(Options(cycle=str(mine)), _body(), FPS)


def test_the_model_that_ships_uses_it():
    definition = load_definition("walker")
    assert definition.dynamics.kind == "walking_cycle" and definition.kernel.kind == "tempered"
    # What the file says is what the options are without it.
    assert definition.dynamics.options == Options()


@pytest.mark.parametrize("change", [{"residual": np.zeros(3)}, {"mean": np.zeros((4, 25))}, {"modes": np.zeros((0, 17, 25))}])
def test_a_malformed_cycle_is_a_sentence(tmp_path, cycle, change):
    path = tmp_path / "cycle.npz"
    save_angle_cycle(cycle, path)
    assert np.allclose(load_angle_cycle(path).mean, cycle.mean)
    with np.load(path) as file:
        arrays = dict(file)
    np.savez(path, **arrays | change)
    with pytest.raises(InputError, match="learn walking-angles"):
        load_angle_cycle(path)
    path.write_bytes(b"PK\x03\x04")
    with pytest.raises(InputError, match="a walking cycle in joint angles"):
        load_angle_cycle(path)
    with pytest.raises(InputError, match="no such file"):
        load_angle_cycle(tmp_path / "none.npz")
