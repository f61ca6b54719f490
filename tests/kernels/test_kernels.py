"""What every kernel of the registry keeps to: one signature, finite output, one trace for all frames, and a way out of hopeless frames."""

import inspect
import math
from dataclasses import dataclass
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import numpyro.distributions as dist
import pytest

from bayes_body import kernels
from bayes_body.base.registry import find, names
from bayes_body.density.density import Density
from bayes_body.density.factor import Factor, Particles, Transition, Variable
from bayes_body.density.kernel import NO_ANCESTOR
from bayes_body.density.spaces import Plate, euclidean
from bayes_body.kernels.batching import everywhere, replicated

X = Variable("x")
COUNT = 500
# One point of the plane, as an entry of a plate, without which a graph has no nodes.
SPACE = Plate(("point",), euclidean(("x", "y"), ("", "")))


class _Walk(dist.Independent):
    """Independent steps of every entry of a plate."""

    def entries(self):
        return jax.vmap(lambda loc, scale: dist.Normal(loc, scale).to_event(1))(self.base_dist.loc, self.base_dist.scale)


@partial(jax.tree_util.register_dataclass, meta_fields=[], data_fields=[])
@dataclass(frozen=True)
class _Flat:
    """The entries one after the other, as samplers of vectors need them."""

    def constrain(self, position):
        return {"x": position["x"].reshape(1, 2)}

    def unconstrain(self, state):
        return {"x": state["x"].ravel()}

    def log_determinant(self, position):
        return 0.0 * jnp.sum(position["x"])


def _flat(state):
    return _Flat()


def _walk(previous):
    return {"x": _Walk(dist.Normal(previous["x"], jnp.full((1, 2), 0.5)), 2)}


def _noise(state, scale):
    return {"x": dist.Normal(state["x"], 0.5 * scale).to_event(2)}


def _skewed(values, data):
    """Of y = inf minus infinity everywhere, of y = nan no number; no number either where x does not lie above a floor."""
    x, (y, floor) = values[X], data
    return jnp.where(x[0, 0] > floor, jnp.sum(2.0 * (x - y) - jnp.exp(2.0 * (x - y))), jnp.nan)


def _wall(values, most):
    return jnp.where(values[X][0, 0] > most, -jnp.inf, 0.0)


def density(y=(0.5, -0.5), floor=-jnp.inf, wall=jnp.inf):
    """One density for all tests, of data that differ: each kernel is compiled once."""
    factors = Factor("y", "likelihood", (X,), jax.tree_util.Partial(_skewed)), Factor("wall", "constraint", (X,), jax.tree_util.Partial(_wall))
    data = {"y": (jnp.array(y), jnp.array(floor)), "wall": jnp.array(wall)}
    return Density(
        Transition("walk", jax.tree_util.Partial(_walk), jax.tree_util.Partial(_noise), chart=jax.tree_util.Partial(_flat), spaces=(("x", SPACE),)),
        factors,
        data,
        start(),
    )


def start():
    return everywhere(Particles({"x": jnp.zeros((COUNT, 1, 2))}, jnp.full(COUNT, -math.log(COUNT), jnp.float32)))


class Counted:
    """A kernel, compiled once for all tests; `traces` holds the number of particles of each trace."""

    def __init__(self, kernel):
        self.traces = []

        def counted(key, particles, density):
            self.traces.append(len(particles.log_weights))
            return kernel(key, particles, density)

        self.step = jax.jit(counted, out_shardings=replicated())

    def __call__(self, key, particles, density):
        return self.step(key, particles, density)


@pytest.fixture(params=names("kernel"), scope="module")
def kernel(request):
    term = find("kernel", request.param)
    return Counted(term.build(options=term.options()))


def test_signature_and_finite_output(kernel):
    particles, info = kernel(jax.random.key(0), start(), density())
    assert particles.states["x"].shape == (COUNT, 1, 2) and particles.log_weights.shape == (COUNT,)
    assert np.isfinite(particles.states["x"]).all() and np.isfinite(particles.log_weights).all()
    assert np.isclose(np.exp(np.asarray(particles.log_weights, float)).sum(), 1, atol=1e-4)
    assert info.ancestors.shape == (COUNT,) and info.ancestors.max() < COUNT
    assert info.ancestors.min() >= 0 or (info.ancestors == NO_ANCESTOR).all()
    assert 1 <= info.ess <= COUNT + 1e-3
    assert info.survival_rate.shape == info.inverse_temperatures.shape
    assert not info.lost


@pytest.mark.parametrize("name", names("kernel"))
def test_its_options_stand_in_its_signature_and_in_its_help(name):
    options, build = set(find("kernel", name).options.model_fields) - {"particles"}, getattr(kernels, name)
    assert options <= set(inspect.signature(build).parameters) and all(f"{option}: " in build.__doc__ for option in options)


def test_one_trace_for_all_frames(kernel):
    particles = start()
    for frame in range(4):
        particles, _ = kernel(jax.random.key(frame), particles, density((0.1 * frame, -0.2)))
    assert kernel.traces.count(COUNT) == 1


@pytest.mark.parametrize("y", [np.inf, np.nan], ids=["impossible", "not a number"])
def test_a_hopeless_frame_is_said_and_the_prediction_kept(kernel, y):
    particles, info = kernel(jax.random.key(0), start(), density((y, y)))
    assert info.lost
    assert np.isfinite(particles.states["x"]).all()
    assert np.allclose(np.exp(particles.log_weights), 1 / COUNT, rtol=1e-4)


def test_nan_particles_get_no_weight(kernel):
    particles, info = kernel(jax.random.key(0), start(), density(floor=0.0))
    weights = np.exp(np.asarray(particles.log_weights))
    assert not info.lost
    assert weights[np.asarray(particles.states["x"])[:, 0, 0] <= 0].sum() == 0


def test_a_constraint_holds(kernel):
    particles, _ = kernel(jax.random.key(0), start(), density((1.5, 0.0), wall=0.3))
    weights = np.exp(np.asarray(particles.log_weights))
    assert weights[np.asarray(particles.states["x"])[:, 0, 0] > 0.3].sum() == 0


def test_the_same_key_gives_the_same_particles(kernel):
    one, other, third = (kernel(jax.random.key(k), start(), density())[0].states["x"] for k in (1, 1, 2))
    assert (one == other).all() and not (one == third).all()


# Each is a program of its own; how particles are put into batches, tests/kernels/test_batching.py tests alone.
@pytest.mark.parametrize("count", [pytest.param(33, marks=pytest.mark.slow), *(pytest.param(count, marks=pytest.mark.long) for count in (1, 65, 31))])
def test_any_number_of_particles(kernel, count):
    few = Particles({"x": jnp.zeros((count, 1, 2))}, jnp.full(count, -jnp.log(count)))
    particles, info = kernel(jax.random.key(0), few, density())
    assert particles.states["x"].shape == (count, 1, 2) and np.isfinite(info.ess)
