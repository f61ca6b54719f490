"""The joint density of a window of frames against the sum of its parts by hand, for a memory of one frame and of two."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import numpyro.distributions as dist
import pytest
from closed_forms.processes import BEFORE, FIRST, LOOK, LOOK_SD, ROOT, SECOND, SEEN

from bayes_body.base.errors import InputError
from bayes_body.density.ahead import Ahead
from bayes_body.density.density import Density
from bayes_body.density.factor import Factor, Particles, Variable
from bayes_body.density.frames import stacked
from bayes_body.density.trajectory import trajectory
from bayes_body.model.dynamics.diffusion import TruncatedWalk

COUNT, MANY = 4, 5
PATH = 0.5 * jax.random.normal(jax.random.key(7), (COUNT + 2, 2))
LATER = Ahead({"x": PATH[COUNT:]}, jnp.array([True, True]))


def _like(values, z):
    """A factor that reads the frame before: a state dislikes to be far from half the one before."""
    return -jnp.sum((values[Variable("x")] - 0.5 * values[Variable("x", -1)]) ** 2) * z


def _mixture(process, count):
    x = jax.random.normal(jax.random.key(1), (count, 2))
    earlier = x + 0.3 * jax.random.normal(jax.random.key(2), (count, 2))
    weights = jax.nn.log_softmax(jax.random.normal(jax.random.key(3), (count,)))
    return Particles({"x": x} | ({BEFORE: earlier} if process.memory == 2 else {}), weights)


def _densities(process, before, linked):
    for frame in range(COUNT + 1):
        density = process.density(frame, before)
        if linked:
            factor = Factor("link", "likelihood", (Variable("x"), Variable("x", -1)), jax.tree_util.Partial(_like))
            density = dataclasses.replace(density, factors=(*density.factors, factor), data={**density.data, "link": jnp.asarray(0.1 * frame + 0.2)})
        yield density


def _by_particle(process, before, linked, later, x):
    """The log-density of a window after each particle, frame by frame."""
    frames = jnp.concatenate([x, PATH[COUNT:]]) if later else x

    def after(here, earlier, log_density):
        for frame, value in enumerate(frames):
            mean = jnp.asarray(process.on) @ here + jnp.asarray(process.back) @ earlier
            log_density += dist.MultivariateNormal(mean, scale_tril=jnp.asarray(ROOT)).log_prob(value)
            if frame < COUNT:
                log_density += dist.Normal(LOOK @ value, LOOK_SD).log_prob(SEEN[frame])[0]
            # Of the frames after the window, only the next one's links read the window.
            if linked and frame <= COUNT:
                log_density -= (0.1 * frame + 0.2) * jnp.sum((value - 0.5 * here) ** 2)
            earlier, here = here, value
        return log_density

    return jax.vmap(after)(before.states["x"], before.states.get(BEFORE, before.states["x"]), before.log_weights)


# Slow: after one particle.
CASES = [
    pytest.param(process, count, joined, marks=pytest.mark.slow if count == 1 else ())
    for process in (FIRST, SECOND)
    for count in (1, MANY)
    for joined in (False, True)
]


@pytest.mark.parametrize(("process", "count", "joined"), CASES)
def test_the_value_and_the_gradient_are_those_of_the_parts(process, count, joined):
    """Joined: with a factor that reads the frame before, and fixed frames after the window."""
    linked = later = joined
    before = _mixture(process, count)
    *densities, after = _densities(process, before, linked)
    ahead = Ahead({"x": LATER.sampled["x"][: process.memory]}, LATER.exists[: process.memory]) if later else None
    states = {"x": PATH[:COUNT]} | ({BEFORE: PATH[:COUNT]} if process.memory == 2 else {})
    target = trajectory(stacked(densities), before, states, ahead, after if later else None)

    def hand(x):
        value = jax.nn.logsumexp(_by_particle(process, before, linked, later, x))
        if later and process.memory == 1:
            # A transition of memory one does not reach the second frame after the window.
            value -= dist.MultivariateNormal(jnp.asarray(process.on) @ PATH[COUNT], scale_tril=jnp.asarray(ROOT)).log_prob(PATH[COUNT + 1])
        return value

    both = jax.jit(lambda x: [jax.value_and_grad(density)(x) for density in (lambda x: target({"x": x}), hand)])
    (given, slope), (exact, exact_slope) = both(PATH[:COUNT])
    assert np.isclose(given, exact, rtol=1e-5)
    assert np.allclose(slope, exact_slope, rtol=1e-4, atol=1e-4)


def _between(previous):
    return {"x": TruncatedWalk(previous["x"], jnp.full(1, 0.4), jnp.zeros(1), jnp.ones(1))}


def _walled(data):
    """A random walk between 0 and 1 that is seen with noise."""
    transition = dataclasses.replace(FIRST.transition, conditional=jax.tree_util.Partial(_between))
    factor = Factor(
        "z", "likelihood", (Variable("x"),), jax.tree_util.Partial(lambda values, z: jnp.sum(dist.Normal(values[Variable("x")], 0.3).log_prob(z)))
    )
    return Density(transition, (factor,), {"z": data}, Particles({"x": jnp.full((1, 1), 0.5)}, jnp.zeros(1)))


def test_between_limits_the_jacobian_is_that_of_the_coordinates():
    seen, x = jnp.array([0.05, 0.4, 0.15]), jnp.array([[0.03], [0.6], [0.2]])
    densities = [_walled(z) for z in seen]
    target = trajectory(stacked(densities), densities[0].previous, {"x": x})

    @jax.jit
    def program(x):
        pairs = zip(densities, [jnp.array([0.5]), *x], x, strict=False)
        parts = [density.log_weight({"x": here}, {}) + _between({"x": before})["x"].log_prob(here) for density, before, here in pairs]
        bijection = dist.biject_to(_between({"x": x[0]})["x"].support)
        jacobian = sum(bijection.log_abs_det_jacobian(bijection.inv(here), here) for here in x)
        position = target.position({"x": x})
        return target(position), sum(parts), jacobian, target.states(position)["x"]

    value, parts, jacobian, back = program(x)
    assert jacobian < -0.1
    assert np.isclose(value, float(parts) + float(jacobian), rtol=1e-5)
    assert np.allclose(back, x, atol=1e-5)


def test_the_particle_before_is_drawn_given_the_window():
    before = _mixture(SECOND, MANY)
    target = trajectory(SECOND.frames(COUNT), before, {"x": PATH[:COUNT], BEFORE: PATH[:COUNT]})

    @jax.jit
    def program(x):
        exact = jax.nn.log_softmax(_by_particle(SECOND, before, False, False, x))
        return target.ancestor_log_probs({"x": x}), exact, target.complete(jax.random.key(0), {"x": x})

    given, exact, (states, ancestor) = program(PATH[:COUNT])
    assert np.allclose(given, exact, atol=1e-4)
    assert np.allclose(states[BEFORE], jnp.concatenate([before.states["x"][ancestor][None], PATH[: COUNT - 1]]))


@pytest.mark.parametrize("process", [pytest.param(FIRST, id="first order"), pytest.param(SECOND, id="second order", marks=pytest.mark.slow)])
def test_with_a_gaussian_prior_the_window_is_the_exact_smoother(process):
    """Particles from a normal distribution: the slope at the exact mean is zero, and the curvature is the inverse of the exact covariance."""
    mean, covariance = process.exact()
    x = jnp.asarray(mean, float).reshape(-1, 2)
    states = {"x": x} | ({BEFORE: x} if process.memory == 2 else {})
    before = process.start(jax.random.key(0), 20_000)
    target = trajectory(process.frames(), before, states, gaussian=jax.random.key(1))
    slope, curvature = jax.jit(lambda x: (jax.grad(target)({"x": x})["x"], jax.hessian(target)({"x": x})["x"]["x"]))(x)
    root = np.linalg.cholesky(covariance)
    # The particles' own moments are off by about a hundredth.
    assert np.abs(root.T @ np.asarray(slope, float).ravel()).max() < 0.05
    assert np.abs(root.T @ np.asarray(curvature, float).reshape(root.shape) @ root + np.eye(len(root))).max() < 0.05


def test_a_gaussian_prior_is_refused_where_a_term_compares_frames():
    frames, before = FIRST._replace(linked=True).frames(), FIRST.start(jax.random.key(0))
    with pytest.raises(InputError, match="a Gaussian prior of a window: a term compares a frame with the frame before"):
        trajectory(frames, before, {"x": jnp.zeros((len(SEEN), 2))}, gaussian=jax.random.key(0))


@pytest.mark.parametrize("densities", [[], [_walled(jnp.zeros(())), _walled(jnp.zeros(2))]], ids=["none", "of other shapes"])
def test_frames_that_do_not_fit_are_refused(densities):
    with pytest.raises(InputError, match=r"the window: data of other shapes|the frames: none"):
        stacked(densities)
