"""The truncated random walk: normalised for every previous state, drawn from as it is evaluated, finite to its limits."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpyro.distributions import biject_to
from scipy import stats

from bayes_body.base.errors import InputError
from bayes_body.model.body.build import Shape, build_body
from bayes_body.model.definition import load_body
from bayes_body.model.dynamics.diffusion import Options, TruncatedWalk, build

LOW, HIGH = -0.4, 1.1
LOCATIONS = [LOW, LOW + 1e-4, 0.0, 0.7, HIGH]


@pytest.fixture(autouse=True)
def double_precision():
    with jax.enable_x64(True):
        yield


def _walk(loc, scale, low=LOW, high=HIGH):
    return TruncatedWalk(*(jnp.array([value]) for value in (loc, scale, low, high)))


@pytest.mark.parametrize("scale", [0.01, 0.3, 5.0])
@pytest.mark.parametrize("loc", LOCATIONS)
def test_it_integrates_to_one(loc, scale):
    edges = jnp.linspace(LOW, HIGH, 200_001)
    middle = (edges[1:] + edges[:-1]) / 2
    density = jnp.exp(jax.jit(jax.vmap(lambda x: _walk(loc, scale).log_prob(x[None])))(middle))
    assert abs(jnp.sum(density) * (edges[1] - edges[0]) - 1) < 1e-6


def test_without_limits_it_is_the_normal():
    x = jnp.linspace(-3, 3, 7)
    values = jax.jit(jax.vmap(lambda v: _walk(0.4, 0.8, -jnp.inf, jnp.inf).log_prob(v[None])))(x)
    assert np.allclose(values, stats.norm(0.4, 0.8).logpdf(x), atol=1e-12)


def test_one_sided_limits():
    values = _walk(0.2, 0.5, 0.0, jnp.inf).log_prob(jnp.array([0.3]))
    assert np.isclose(values, stats.truncnorm(-0.4, np.inf, 0.2, 0.5).logpdf(0.3), atol=1e-10)


@pytest.mark.parametrize("scale", [0.05, 0.4])
@pytest.mark.parametrize("loc", LOCATIONS)
def test_draws_follow_the_density(loc, scale):
    draws = np.asarray(_walk(loc, scale).sample(jax.random.key(int(1000 * (loc + 2) + 10 * scale)), (20_000,)))[:, 0]
    assert draws.min() >= LOW and draws.max() <= HIGH
    exact = stats.truncnorm((LOW - loc) / scale, (HIGH - loc) / scale, loc, scale)
    assert stats.kstest(draws, exact.cdf).pvalue > 1e-3


def test_outside_the_limits_the_density_is_zero():
    assert jnp.isneginf(_walk(0.0, 0.3).log_prob(jnp.array([HIGH + 1e-6])))


@pytest.mark.parametrize("loc", LOCATIONS)
def test_gradients_equal_central_differences(loc):
    def value(loc, x):
        return _walk(loc, 0.2).log_prob(x[None])

    step, x = 1e-6, jnp.array(0.35)
    numeric = (value(loc + step, x) - value(loc - step, x)) / (2 * step)
    assert np.isclose(jax.jit(jax.grad(value))(jnp.array(loc), x), numeric, rtol=1e-5, atol=1e-6)


def test_infinite_sides_leave_gradients_finite():
    gradient = jax.jit(jax.grad(lambda loc: _walk(loc, 0.2, -jnp.inf, jnp.inf).log_prob(jnp.array([0.1]))))(jnp.array(0.3))
    assert np.isclose(gradient, (0.1 - 0.3) / 0.04, rtol=1e-6)


def test_the_bijection_is_one_and_its_determinant_right():
    low, high = jnp.array([-1.0, -jnp.inf, 0.0, -1.0, -jnp.inf]), jnp.array([2.0, jnp.inf, 0.1, 2.0, 0.0])
    support = TruncatedWalk(jnp.array([0.0, 0.0, 0.05, 0.0, -1.0]), jnp.ones(5), low, high).support
    bijection = biject_to(support)
    x = jnp.array([0.3, -4.0, 0.3, -1.4, 0.2])
    y = bijection(x)
    assert support(y) and y[1] == x[1]
    # Only near a limit do coordinate and angle differ, and a coordinate far beyond it is still inside.
    assert np.isclose(y[0], x[0], atol=1e-9) and 0 < y[3] - low[3] < 1e-4
    assert support(bijection(jnp.array([90.0, 90.0, 90.0, -90.0, 90.0], jnp.float32)))
    assert np.allclose(bijection.inv(y), x, atol=1e-9)
    exact = jnp.linalg.slogdet(jax.jacobian(bijection)(x))[1]
    assert np.isclose(bijection.log_abs_det_jacobian(x, y), exact, atol=1e-10)


@pytest.fixture
def arm():
    return build_body("arm_4", load_body("arm_4"), Shape())


def test_standard_deviations_by_name_pattern_and_frame_rate(arm):
    options = Options(sd_deg={"shoulder_*": 3.0, "shoulder_y": 6.0, "elbow": 2.0}, at_fps=60)
    at_15 = build(options, arm, fps=15.0)
    sd = at_15.conditional({"pose": jnp.zeros(4)})["pose"].scale
    # Four times the time between frames: twice the standard deviation.
    assert np.allclose(np.degrees(sd), [6.0, 12.0, 6.0, 4.0])
    over_four = build(options, arm, fps=60.0, subject_sd={"elbow": 0.1}, gap=4.0)
    assert np.allclose(over_four.conditional({"pose": jnp.zeros(4)})["pose"].scale, [*np.radians([6.0, 12.0, 6.0]), 0.2])


def test_the_subjects_own_deviations_win_where_asked(arm):
    own = {"elbow": 0.5}
    for use, expected in ((True, 0.5), (False, math.radians(2.0))):
        transition = build(Options(sd_deg={"*": 2.0}, use_subject_sd=use), arm, fps=60.0, subject_sd=own)
        assert np.isclose(transition.conditional({"pose": jnp.zeros(4)})["pose"].scale[3], expected)


def test_noise_is_centred_on_the_state_and_scaled(arm):
    transition = build(Options(sd_deg={"*": 2.0}), arm, fps=60.0)
    noise = transition.perturbation({"pose": jnp.array([0.1, 0.2, 0.3, -0.4])}, jnp.array(0.25))["pose"]
    assert np.allclose(noise.loc, [0.1, 0.2, 0.3, -0.4])
    assert np.allclose(np.degrees(noise.scale), 0.5)


@pytest.mark.parametrize(
    ("table", "message"),
    [
        ({"sholder_*": 3.0, "*": 1.0}, "dynamics.sd_deg.sholder_*: matches no dof of the body in degrees; did you mean 'shoulder_"),
        ({"shoulder_*": 3.0}, "no standard deviation for the dof 'elbow'"),
    ],
)
def test_deviations_that_fit_no_dof(arm, table, message):
    with pytest.raises(InputError) as error:
        build(Options(sd_deg=table), arm, fps=60.0)
    assert message in str(error.value)
