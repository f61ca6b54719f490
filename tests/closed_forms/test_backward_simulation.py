"""Backward simulation against exact smoothers: of linear Gaussian processes of first and of second order, and of a walk between limits."""

import dataclasses
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import numpyro.distributions as dist
import pytest
from closed_forms.processes import FIRST, LINKED, PARTICLES, SECOND, SEEN, distance

from bayes_body.density.density import Density
from bayes_body.density.factor import Factor, Particles, Transition, Variable
from bayes_body.kernels.batching import everywhere
from bayes_body.kernels.paths import smoother
from bayes_body.kernels.paths.smoother import build_smoother
from bayes_body.kernels.smc.particle_filter import build_kernel
from bayes_body.model.dynamics import diffusion
from bayes_body.model.dynamics.diffusion import TruncatedWalk
from bayes_body.tracking.backward import Backward, Filtered

# These programs run for longer than they compile.
pytestmark = pytest.mark.usefixtures("optimised")

KEYS, DRAWS = 16, 500


@jax.jit
def step(key, particles, density):
    return build_kernel()(key, particles, density)


def smoothed(process, change=lambda transition: transition, frames=len(SEEN), **options):
    """Mean and covariance of the paths of each key, (key, 12) and (key, 12, 12)."""
    found, count = [], frames
    built = build_smoother(draws=DRAWS, **options)

    def density(frame, previous):
        made = process.density(frame, previous)
        return Density(change(made.transition), made.factors, made.data, made.previous)

    frames: list[Filtered] = []
    walk = Backward(built, change(process.transition), lambda t: frames[t], density)
    for seed in range(KEYS):
        key, particles = jax.random.key(seed), process.start(jax.random.key(seed + 1000))
        frames.clear()
        for frame in range(count):
            particles, info = step(jax.random.fold_in(key, frame), particles, process.density(frame, particles))
            frames.append(Filtered(particles, info.ancestors, frame == 0))
        paths = {one.frame: np.asarray(one.states["x"], float) for one in walk.follow(jax.random.key(seed + 2000), count)}
        found.append(np.concatenate([paths[t] for t in range(count)], axis=1))
    draws = np.array(found)
    means = draws.mean(axis=1)
    return means, np.array([np.cov(each.T) for each in draws])


def check(process, change=lambda transition: transition, **options):
    """Means and covariances of all frames together, those of neighbours too, within four standard errors over the keys."""
    for name, given, found in zip(("mean", "covariance"), process.exact(), smoothed(process, change, **options), strict=True):
        assert distance(given, found) < 4, f"{name}: {distance(given, found):.1f} standard errors from the exact smoother"


WAYS = {
    "particles": {"start": "particles", "moves": 0},
    "particles moved": {"start": "particles", "moves": 2},
    "ensemble": {"start": "ensemble", "moves": 0},
    "ensemble moved": {"start": "ensemble", "moves": 2},
}


# With the linked process below, which goes over particles and moves, one of each start.
DEFAULT = {("second order", "ensemble")}
CASES = [
    pytest.param(process, way, id=f"{order}, {way}", marks=[] if (order, way) in DEFAULT else pytest.mark.slow)
    for order, process in (("first order", FIRST), ("second order", SECOND))
    for way in WAYS
]


@pytest.mark.slow
@pytest.mark.parametrize(("process", "way"), CASES)
def test_the_paths_are_those_of_the_exact_smoother(process, way):
    check(process, **WAYS[way])


@pytest.mark.slow
def test_the_paths_know_what_is_seen_of_a_step():
    check(LINKED, **WAYS["particles moved"])


@pytest.mark.slow
def test_a_smoother_that_forgets_what_is_seen_of_a_step_is_found_out(monkeypatch):
    given = smoother.log_between
    monkeypatch.setattr(smoother, "log_between", lambda transition, before, state, ahead, after=None: given(transition, before, state, ahead))
    with pytest.raises(AssertionError, match="standard errors from the exact smoother"):
        check(LINKED, start="particles", moves=6)


@pytest.mark.slow
@pytest.mark.parametrize("process", [pytest.param(SECOND, id="second order"), pytest.param(LINKED, id="linked")])
def test_paths_go_on_from_stored_frames_as_if_they_had_never_stopped(process):
    """Each state is stored only once what it carries is known; the density of a stored frame counts for the one before it.

    All frames share their programs, also the last ones, which lack neighbours: compiling takes most of a smoother's time.
    """
    frames, particles, kernel = [], process.start(jax.random.key(0)), jax.jit(build_kernel())
    for frame in range(len(SEEN)):
        after, info = kernel(jax.random.key(frame), particles, process.density(frame, particles))
        particles = Particles(dict(after.states), after.log_weights)
        frames.append(Filtered(*everywhere((particles, info.ancestors)), frame in (0, 1)))

    walk = Backward(build_smoother(draws=20), process.transition, lambda t: frames[t], process.density)
    whole = {each.frame: each for each in walk.follow(jax.random.key(9), len(SEEN))}
    assert [getattr(walk.steps, step)._cache_size() for step in ("predict", "regress", "move")] == [1, 1, 1]
    assert list(whole) == [5, 4, 3, 2, 1, 0]
    for first in (5, 3, 1):
        rest = list(walk.follow(jax.random.key(9), len(SEEN), lambda t: whole[t]._replace(begins=False), first))
        assert [each.frame for each in rest] == list(range(first - 1, -1, -1))
        for each in rest:
            jax.tree.map(np.testing.assert_array_equal, dict(each.states), dict(whole[each.frame].states))


@pytest.mark.slow
def test_a_smoother_that_ignores_the_second_frame_is_found_out():
    with pytest.raises(AssertionError, match="standard errors from the exact smoother"):
        check(SECOND, lambda transition: dataclasses.replace(transition, memory=1), **WAYS["particles"])


@pytest.mark.slow
def test_a_smoother_that_keeps_what_a_particle_carries_is_found_out(monkeypatch):
    """The naive form: the frame after the next is weighed with the pose that the particle of the next frame came from."""

    def naive(transition, state, ahead, after=None):
        total, before = jnp.zeros(()), state
        for k in range(ahead.exists.shape[0]):
            here = {**before, "x": ahead.sampled["x"][k]}
            total += jnp.where(ahead.exists[k], transition.log_density(here, before), 0.0)
            before = here
        return total

    monkeypatch.setattr(smoother, "log_ahead", naive)
    with pytest.raises(AssertionError, match="standard errors from the exact smoother"):
        check(SECOND, **WAYS["particles"])


# -- a walk between two limits: its density has another normaliser from each place --------------------------------------------------------------

LOW, HIGH, SD, GRID = 0.0, 1.0, 0.4, (np.arange(400) + 0.5) / 400
NEAR = np.array([0.05, 0.4, 0.15, 0.9, 0.6])


def _between(previous):
    return {"x": TruncatedWalk(previous["x"], jnp.full(1, SD), jnp.full(1, LOW), jnp.full(1, HIGH))}


def _between_noise(state, scale):
    return {"x": TruncatedWalk(state["x"], scale * jnp.full(1, SD), jnp.full(1, LOW), jnp.full(1, HIGH))}


def _near(values, z):
    return jnp.sum(dist.Normal(values[Variable("x")], 0.3).log_prob(z))


class Walled(NamedTuple):
    """A random walk truncated to [0, 1], seen with noise."""

    @property
    def transition(self):
        return Transition("walled", jax.tree_util.Partial(_between), jax.tree_util.Partial(_between_noise))

    def density(self, frame, previous):
        factor = Factor("z", "likelihood", (Variable("x"),), jax.tree_util.Partial(_near))
        return Density(self.transition, (factor,), {"z": jnp.asarray(NEAR[frame])}, previous)

    def start(self, key):
        return Particles({"x": jnp.full((PARTICLES, 1), 0.5)}, jnp.full(PARTICLES, -jnp.log(PARTICLES)))

    def exact(self):
        """Means and the covariance of all frames, by quadrature: forwards and backwards on a grid."""
        steps = np.exp(-0.5 * ((GRID[:, None] - GRID) / SD) ** 2)
        steps /= steps.sum(axis=1, keepdims=True)
        seen = np.exp(-0.5 * ((GRID - NEAR[:, None]) / 0.3) ** 2)
        first = np.exp(-0.5 * ((GRID - 0.5) / SD) ** 2)
        forward, backward = [first / first.sum() * seen[0]], [np.ones_like(GRID)]
        for each in seen[1:]:
            forward.append(forward[-1] @ steps * each)
        for each in seen[:0:-1]:
            backward.insert(0, steps @ (each * backward[0]))
        frames = len(NEAR)
        marginals = [f * b / (f @ b) for f, b in zip(forward, backward, strict=True)]
        means = np.array([m @ GRID for m in marginals])
        covariance = np.empty((frames, frames))
        for i in range(frames):
            onward = forward[i] * GRID
            for j in range(i, frames):
                onward = onward if j == i else onward @ steps * seen[j]
                both = (onward * GRID) @ backward[j] / (forward[j] @ backward[j])
                covariance[i, j] = covariance[j, i] = both - means[i] * means[j]
        return means, covariance


@pytest.mark.slow
def test_between_limits_the_paths_are_those_of_quadrature():
    check(Walled(), frames=len(NEAR), **WAYS["particles moved"])


@pytest.mark.long
def test_the_moves_mend_an_ensemble_that_is_not_normal():
    check(Walled(), frames=len(NEAR), start="ensemble", moves=40)


@pytest.mark.slow
def test_a_density_without_its_normaliser_is_found_out(monkeypatch):
    monkeypatch.setattr(diffusion, "_log_mass", lambda a, b: jnp.zeros_like(a))
    with pytest.raises(AssertionError, match="standard errors from the exact smoother"):
        check(Walled(), frames=len(NEAR), **WAYS["particles"])


@pytest.mark.slow
def test_a_smoother_that_forgets_the_forward_weights_is_found_out(monkeypatch):
    chosen = smoother.Smoother.choose

    def forgetful(self, key, paths, density, after=None):
        equal = density.previous._replace(log_weights=jnp.full(PARTICLES, -jnp.log(PARTICLES)))
        return chosen(self, key, paths, density.with_previous(equal), after)

    monkeypatch.setattr(smoother.Smoother, "choose", forgetful)
    with pytest.raises(AssertionError, match="standard errors from the exact smoother"):
        check(FIRST, **WAYS["particles"])
