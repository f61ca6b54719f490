"""Beta noise inside joint limits and a second-order prediction: normalised, of the asked mode and variance, drawn from as it is evaluated."""

import math
from functools import cache, partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from bayes_body.base.errors import InputError
from bayes_body.base.toml.read import validate
from bayes_body.model.body.build import Shape, build_body
from bayes_body.model.body.schema import BodySchema
from bayes_body.model.definition import load_body
from bayes_body.model.dynamics.joint_noise import JointNoise, concentration
from bayes_body.model.dynamics.second_order import Options, build

LOW, HIGH = -0.4, 1.9
# Previous states in the range, on its limits, and beyond them by less and by more than the range.
MODES = [LOW - 10.0, LOW - 0.3, LOW, LOW + 1e-4, 0.1, 0.7, HIGH - 0.01, HIGH, HIGH + 0.2, HIGH + 7.0]
SCALES = [0.01, 0.07, 0.3, 0.6]


@pytest.fixture(autouse=True, scope="module")
def double_precision():
    with jax.enable_x64(True):
        yield


def _joint(mode, scale, low=LOW, high=HIGH, angular=True):
    return JointNoise(*(jnp.array([value]) for value in (mode, scale, low, high)), jnp.array([angular]))


# The distribution is an argument: what is compiled serves all of them.
_log_probs = jax.jit(jax.vmap(lambda noise, x: noise.log_prob(x[None]), (None, 0)))
_draws = jax.jit(lambda noise, key: noise.sample(key, (20_000,))[:, 0])
_value_and_slope = jax.jit(jax.value_and_grad(lambda x, noise: noise.log_prob(x[None])))


def _density(noise, points):
    return np.exp(_log_probs(noise, jnp.asarray(points)))


@cache
def _graded(number=200_001):
    """Middles of cells that shrink towards both limits, where a skewed density is steep, and their widths."""
    edges = LOW + (HIGH - LOW) * np.sin(np.linspace(0, math.pi / 2, number)) ** 2
    return (edges[1:] + edges[:-1]) / 2, np.diff(edges)


@pytest.mark.parametrize("scale", [pytest.param(scale, marks=() if scale in (SCALES[0], SCALES[-1]) else pytest.mark.slow) for scale in SCALES])
@pytest.mark.parametrize("mode", MODES)
def test_it_integrates_to_one_with_the_asked_mode_and_variance(mode, scale):
    points, widths = _graded()
    density = _density(_joint(mode, scale), points)
    assert abs(np.sum(density * widths) - 1) < 1e-6
    mean = np.sum(points * density * widths)
    variance = np.sum((points - mean) ** 2 * density * widths)
    assert abs(variance / scale**2 - 1) < 1e-4
    # A grid finer than the tolerance about the mode that was asked for.
    asked = np.clip(mode, LOW, HIGH)
    near = np.clip(asked + np.linspace(-5e-3, 5e-3, 1001) * scale / 0.01, LOW + 1e-9, HIGH - 1e-9)
    assert abs(near[np.argmax(_density(_joint(mode, scale), near))] - asked) < 1e-4 * max(1.0, scale / 0.01)


def test_the_mode_is_where_the_slope_is_zero():
    for mode in (LOW + 0.05, 0.1, 0.7, 1.5):
        for scale in SCALES:
            noise = _joint(mode, scale)
            assert abs(_value_and_slope(mode, noise)[1]) < 1e-6 / scale


def test_the_density_is_that_of_scipy():
    noise = _joint(0.3, 0.2)
    points = np.linspace(LOW + 1e-3, HIGH - 1e-3, 201)
    law = stats.beta(float(noise.alpha[0]), float(noise.beta[0]), LOW, HIGH - LOW)
    assert np.allclose(_density(noise, points), law.pdf(points), rtol=1e-6)


@pytest.mark.parametrize("scale", [0.07, 0.5])
@pytest.mark.parametrize("mode", [LOW - 0.3, LOW, 0.1, HIGH, HIGH + 7.0])
def test_draws_follow_the_density(mode, scale):
    noise = _joint(mode, scale)
    draws = np.asarray(_draws(noise, jax.random.key(int(100 * (mode + 20) + 10 * scale))))
    assert draws.min() >= LOW and draws.max() <= HIGH
    points, widths = _graded(20_001)
    cumulative = np.cumsum(_density(noise, points) * widths)
    assert stats.kstest(draws, lambda x: np.interp(x, points, cumulative)).pvalue > 1e-3


def test_draws_in_single_precision_stay_inside():
    with jax.enable_x64(False):
        noise = _joint(HIGH + 1.0, 0.01)
        draws = _draws(noise, jax.random.key(0))
        values = _log_probs(noise, draws)
    assert draws.dtype == jnp.float32 and np.isfinite(values).all()


@pytest.mark.parametrize("mode", [LOW, 0.5, HIGH, HIGH + 30.0])
def test_at_the_limits_the_log_density_is_bounded_and_outside_it_is_none(mode):
    noise = _joint(mode, 0.05)
    for limit in (LOW, HIGH):
        value, slope = _value_and_slope(limit, noise)
        assert math.isfinite(value) and math.isfinite(slope)
    assert (np.asarray(_log_probs(noise, jnp.array([LOW - 1e-6, HIGH + 1e-6]))) == -math.inf).all()


def test_the_derivative_by_the_previous_state_is_that_of_differences():
    def log_prob(mode):
        return _joint(mode, 0.2).log_prob(jnp.array([0.35]))

    value_and_slope = jax.jit(jax.value_and_grad(log_prob))
    for mode in (-0.2, 0.1, 1.0, 1.85):
        difference = (value_and_slope(mode + 1e-6)[0] - value_and_slope(mode - 1e-6)[0]) / 2e-6
        assert np.isclose(value_and_slope(mode)[1], difference, rtol=1e-6)
    # Beyond a limit the clipped mode no longer follows the prediction.
    assert value_and_slope(HIGH + 0.5)[1] == 0.0


def test_the_concentration_over_the_whole_range():
    modes, variances = np.meshgrid(np.linspace(0, 1, 101), np.geomspace(1e-8, 0.999 / 12, 60))
    kappa = np.asarray(jax.jit(concentration)(jnp.asarray(modes), jnp.asarray(variances)))
    a, b = 1 + modes * kappa, 1 + (1 - modes) * kappa
    assert np.all(kappa >= 0)
    assert np.allclose(a * b / ((a + b) ** 2 * (a + b + 1)), variances, rtol=1e-9)


def test_a_full_turn_has_no_wall_and_integrates_to_one():
    noise = _joint(3.1, 0.4, -np.inf, np.inf)
    turn = np.linspace(-math.pi, math.pi, 200_001)
    middle = (turn[1:] + turn[:-1]) / 2
    assert abs(np.sum(_density(noise, middle)) * (turn[1] - turn[0]) - 1) < 1e-8
    assert np.allclose(_density(noise, middle), _density(noise, middle + 2 * math.pi))
    wide = _joint(3.1, 1.5, -np.inf, np.inf)
    assert abs(np.sum(_density(wide, middle)) * (turn[1] - turn[0]) - 1) < 1e-4
    slope, other = (_value_and_slope(at, noise)[1] for at in (math.pi, -math.pi))
    assert np.isclose(slope, -(math.pi - 3.1) / 0.4**2) and np.isclose(slope, other)


def test_many_distributions_at_once_agree_with_each_alone():
    """As in a mixture, where limits and scale are the same: inside, at and outside of the limits, across the half turn, with gradients."""
    low, high = jnp.array([LOW, -jnp.inf, -jnp.inf]), jnp.array([HIGH, jnp.inf, jnp.inf])
    centres = jnp.array([[-1.0, math.pi - 0.1, 0.2], [0.3, -math.pi - 0.4, -0.3], [HIGH, 9.0, 0.0], [7.0, 0.0, 4.0]])
    scale, angular = jnp.array([0.1, 0.5, 0.2]), jnp.array([True, True, False])
    noises = jax.jit(jax.vmap(lambda centre: JointNoise(centre, scale, low, high, angular)))(centres)
    at_once = jax.jit(lambda value: noises.log_prob_each(value))
    by_one = jax.jit(jax.vmap(lambda noise, value: noise.log_prob(value), (0, None)))
    slopes_at_once = jax.jit(jax.jacrev(noises.log_prob_each))
    slopes_by_one = jax.jit(jax.vmap(jax.grad(lambda value, noise: noise.log_prob(value)), (None, 0)))
    for value in ([0.1, -math.pi + 0.1, 0.3], [LOW, 3.0, 0.0], [HIGH, 12.0, -1.0]):
        at = jnp.array(value)
        assert np.allclose(at_once(at), by_one(noises, at), rtol=1e-12) and np.all(np.isfinite(by_one(noises, at)))
        assert np.allclose(slopes_at_once(at), slopes_by_one(at, noises), rtol=1e-9)
    assert np.all(at_once(jnp.array([HIGH + 0.01, 0.0, 0.0])) == -np.inf)


def test_a_shift_has_the_normal_law():
    noise = _joint(100.0, 0.03, -np.inf, np.inf, angular=False)
    points = 100.0 + np.linspace(-0.1, 0.1, 11)
    assert np.allclose(_density(noise, points), stats.norm(100.0, 0.03).pdf(points))


# -- the process ------------------------------------------------------------------------------------------------------------------------


_conditional = jax.jit(lambda transition, previous: transition.conditional(previous))


@cache
def _person():
    return build_body("person_31", load_body("person_31"), Shape())


def _options(**changes):
    table = {"sd_deg": {"*": 2.0}, "sd_m": {"*": 0.01}} | changes
    return validate(Options, table, "dynamics")


def test_the_prediction_is_that_of_the_paper():
    body = _person()
    transition = build(_options(alpha_1=1.7, alpha_2=0.8), body, 60.0)
    rng = np.random.default_rng(0)
    now, before = rng.normal(size=(2, 31)) * 0.3
    noise = _conditional(transition, {"pose": jnp.asarray(now), "pose_before": jnp.asarray(before)})["pose"]
    assert np.allclose(noise.centre, 1.7 * now - 0.8 * before)


def test_the_velocity_of_a_full_turn_is_the_shorter_way_round():
    body = _person()
    transition = build(_options(), body, 60.0)
    yaw = body.dof_names.index("root_yaw")
    before = jnp.asarray(3.1 * np.eye(31)[yaw])
    noise = _conditional(transition, {"pose": -before, "pose_before": before})["pose"]
    assert np.isclose(noise.centre[yaw], -3.1 + 0.8 * (2 * math.pi - 6.2))


def test_the_pose_before_is_carried_and_a_first_pose_stands_still():
    transition = build(_options(), _person(), 60.0)
    first = transition.begin({"pose": jnp.full(31, 0.1)})
    assert np.allclose(_conditional(transition, first)["pose"].centre, 0.1)

    @jax.jit
    def program(key, first):
        after = transition.sample(key, first)
        return after, transition.log_density(after, first), transition.perturb(jax.random.key(1), after, first, jnp.asarray(0.5))

    after, log_density, perturbed = program(jax.random.key(0), first)
    assert np.array_equal(after["pose_before"], first["pose"]) and not np.array_equal(after["pose"], first["pose"])
    assert math.isfinite(log_density)
    assert set(perturbed) == {"pose", "pose_before"}


@pytest.mark.long
def test_at_another_frame_rate_a_body_drifts_as_far():
    ball = {
        "title": "a ball on a rail",
        "source": "none",
        "lengths_of_height": {"ball": 0.1},
        "joint": [{"name": "root", "parent": "world", "dofs": [{"name": "x", "axis": "tx"}]}],
        "part": [{"name": "ball", "joint": "root", "kind": "sphere", "length": "ball", "radius_of_height": [0.05, 0.05]}],
    }
    body = build_body("ball", validate(BodySchema, ball, "ball"), Shape())

    @jax.jit
    @partial(jax.vmap, in_axes=(0, None, None))
    def end(key, transition, frames):
        def step(frame, state):
            return transition.sample(jax.random.fold_in(key, frame), state)

        return jax.lax.fori_loop(0, frames, step, transition.begin({"pose": jnp.zeros(1)}))["pose"][0]

    spread = {}
    for fps in (30.0, 60.0, 120.0):
        keys = jax.random.split(jax.random.key(int(fps)), 2000)
        spread[fps] = float(jnp.std(end(keys, build(_options(sd_deg={}), body, fps), round(2 * fps))))
    # The standard error of a deviation of 2000 draws is 1.6 %; with the factor of white noise or of a random walk it would be off by 30 % and more.
    assert np.allclose([spread[30.0], spread[120.0]], spread[60.0], rtol=0.08)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"alpha_1": 0.5}, "keep -0.3 of the position"),
        ({"alpha_1": 2.5}, r"set alpha_1 = 1 \+ alpha_2"),
        ({"sd_deg": {"*": 2.0, "l_knee": 60.0}}, "'l_knee'.*over √12.*smaller value, or wider limits"),
        ({"sd_deg": {"*": 2.0, "root_yaw": 100.0}}, "'root_yaw'.*a quarter turn"),
        ({"sd_deg": {"l_*": 2.0}}, "no standard deviation for the dof 'root_yaw'"),
        ({"sd_deg": {"*": 2.0, "l_kne": 2.0}}, "l_kne: matches no dof"),
    ],
)
def test_what_cannot_be_is_said(changes, words):
    with pytest.raises((InputError, ValueError), match=words):
        build(_options(**changes), _person(), 60.0)
