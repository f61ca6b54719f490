"""What every kernel of the registry keeps to: one signature, finite output, one trace for all frames, and a way out of hopeless frames."""

import math
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import numpyro.distributions as dist
import pytest

from bayes_body.density import Density
from bayes_body.factor import Factor, Particles, Transition, Variable
from bayes_body.kernels.batching import everywhere, whole
from bayes_body.registry import find, names

X = Variable("x")
COUNT = 500


def _walk(previous):
    return {"x": dist.Normal(previous["x"], 0.5).to_event(1)}


def _noise(state, scale):
    return {"x": dist.Normal(state["x"], 0.5 * scale).to_event(1)}


def _skewed(values, y):
    x = values[X]
    return jnp.sum(2.0 * (x - y) - jnp.exp(2.0 * (x - y)))


def _impossible(values, y):
    return -jnp.inf + 0.0 * jnp.sum(values[X])


def _not_a_number(values, y):
    return jnp.nan * jnp.sum(values[X])


def _half_a_number(values, y):
    return jnp.where(values[X][0] > 0, _skewed(values, y), jnp.nan)


def _wall(values, data):
    return jnp.where(values[X][0] > 0.3, -jnp.inf, 0.0)


def density(potential=_skewed, y=(0.5, -0.5), constraint=None):
    factors = (Factor("y", "likelihood", (X,), jax.tree_util.Partial(potential)),)
    if constraint:
        factors += (Factor("wall", "constraint", (X,), jax.tree_util.Partial(constraint)),)
    return Density(Transition("walk", jax.tree_util.Partial(_walk), jax.tree_util.Partial(_noise)), factors, {"y": jnp.array(y)}, start())


def start():
    return everywhere(Particles({"x": jnp.zeros((COUNT, 2))}, jnp.full(COUNT, -math.log(COUNT), jnp.float32)))


@pytest.fixture(params=names("kernel"))
def kernel(request):
    term = find("kernel", request.param)
    return term.build(options=term.options())


def test_signature_and_finite_output(kernel):
    particles, info = kernel(jax.random.key(0), start(), density())
    assert particles.states["x"].shape == (COUNT, 2) and particles.log_weights.shape == (COUNT,)
    assert np.isfinite(particles.states["x"]).all() and np.isfinite(particles.log_weights).all()
    assert np.isclose(np.exp(np.asarray(particles.log_weights, float)).sum(), 1, atol=1e-4)
    assert info.ancestors.shape == (COUNT,) and info.ancestors.min() >= 0 and info.ancestors.max() < COUNT
    assert 1 <= info.ess <= COUNT + 1e-3
    assert info.survival_rate.shape == info.inverse_temperatures.shape
    assert not info.lost


def test_one_trace_for_all_frames(kernel):
    traces = []

    @partial(jax.jit, out_shardings=whole())
    def step(key, particles, d):
        traces.append(1)
        return kernel(key, particles, d)

    particles = start()
    for frame in range(4):
        particles, _ = step(jax.random.key(frame), particles, density(y=(0.1 * frame, -0.2)))
    assert len(traces) == 1


@pytest.mark.parametrize("potential", [_impossible, _not_a_number])
def test_a_hopeless_frame_is_said_and_the_prediction_kept(kernel, potential):
    particles, info = kernel(jax.random.key(0), start(), density(potential))
    assert info.lost
    assert np.isfinite(particles.states["x"]).all()
    assert np.allclose(np.exp(particles.log_weights), 1 / COUNT, rtol=1e-4)


def test_nan_particles_get_no_weight(kernel):
    particles, info = kernel(jax.random.key(0), start(), density(_half_a_number))
    weights = np.exp(np.asarray(particles.log_weights))
    assert not info.lost
    assert weights[np.asarray(particles.states["x"])[:, 0] <= 0].sum() == 0


def test_a_constraint_holds(kernel):
    particles, _ = kernel(jax.random.key(0), start(), density(y=(1.5, 0.0), constraint=_wall))
    weights = np.exp(np.asarray(particles.log_weights))
    assert weights[np.asarray(particles.states["x"])[:, 0] > 0.3].sum() == 0


def test_the_same_key_gives_the_same_particles(kernel):
    one, other, third = (kernel(jax.random.key(k), start(), density())[0].states["x"] for k in (1, 1, 2))
    assert (one == other).all() and not (one == third).all()


@pytest.mark.parametrize("count", [1, 31, 33, 65])
def test_any_number_of_particles(kernel, count):
    few = Particles({"x": jnp.zeros((count, 2))}, jnp.full(count, -jnp.log(count)))
    particles, info = kernel(jax.random.key(0), few, density())
    assert particles.states["x"].shape == (count, 2) and np.isfinite(info.ess)
