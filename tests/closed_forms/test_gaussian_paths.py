"""Gaussian paths, by moments alone, against the exact smoother of a linear Gaussian process; in pieces of frames, and what they need."""

import jax
import jax.numpy as jnp
import numpy as np
import numpyro.distributions as dist
import pytest
from closed_forms.processes import FIRST_ROOT, LOOK, LOOK_SD, SECOND, SEEN

from bayes_body.base.errors import InputError
from bayes_body.density.density import Density
from bayes_body.density.factor import Factor, Particles, Transition, Variable
from bayes_body.kernels import laplace
from bayes_body.kernels.laplace.proposal import balanced_noise
from bayes_body.kernels.paths.smoother import build_smoother
from bayes_body.tracking.backward import Backward, Filtered
from bayes_body.tracking.draws import FrameResult
from bayes_body.tracking.gaussian_walk import gaussian_pieces

TURN, STEP_SDS = np.array([[1.0, 0.5], [-0.2, 0.9]]), np.array([0.5, 0.3])


def _turned(previous):
    return {"x": dist.Normal(jnp.asarray(TURN) @ previous["x"], jnp.asarray(STEP_SDS)).to_event(1)}


def _spread(state, scale):
    return {"x": dist.Normal(state["x"], scale * jnp.asarray(STEP_SDS)).to_event(1)}


def _look(values, z):
    return jnp.sum(dist.Normal(jnp.asarray(LOOK) @ values[Variable("x")], LOOK_SD).log_prob(z))


def _turning(frame, previous):
    """All frames have the same functions: with a new one, a kernel would be traced anew."""
    transition = Transition("turn", jax.tree_util.Partial(_turned), jax.tree_util.Partial(_spread))
    return Density(
        transition, (Factor("z", "likelihood", (Variable("x"),), jax.tree_util.Partial(_look)),), {"z": jnp.asarray(SEEN[frame])}, previous
    )


def _exact_turning():
    """Mean and covariance of all frames together: the prior's covariance, and then what is seen."""
    count = len(SEEN)
    marginal, covariance = FIRST_ROOT @ FIRST_ROOT.T, np.zeros((2 * count, 2 * count))
    for t in range(count):
        marginal = TURN @ marginal @ TURN.T + np.diag(STEP_SDS**2)
        block = marginal
        for later in range(t, count):
            covariance[2 * later : 2 * later + 2, 2 * t : 2 * t + 2] = block
            covariance[2 * t : 2 * t + 2, 2 * later : 2 * later + 2] = block.T
            block = TURN @ block
    H = np.kron(np.eye(count), LOOK)
    gain = covariance @ H.T @ np.linalg.inv(H @ covariance @ H.T + LOOK_SD**2 * np.eye(count))
    return gain @ SEEN[:, 0], covariance - gain @ H @ covariance


def test_they_are_those_of_the_exact_smoother_whatever_the_draws():
    kernel, frames = jax.jit(laplace(fallback="none")), []
    walk = Backward(build_smoother(draws=100, start="gaussian", moves=0), _turning(0, None).transition, lambda t: frames[t], _turning)
    mean, covariance = _exact_turning()
    apart = np.abs(np.subtract.outer(*[np.arange(len(mean)) // 2] * 2))
    for seed in range(2):
        frames.clear()
        particles = Particles({"x": balanced_noise(jax.random.key(seed), 200, 2) @ FIRST_ROOT.T}, jnp.full(200, -jnp.log(200)))
        for frame in range(len(SEEN)):
            particles, info = kernel(jax.random.key(seed + frame), particles, _turning(frame, particles))
            frames.append(Filtered(particles, info.ancestors, frame == 0))
        paths = {one.frame: np.asarray(one.states["x"], float) for one in walk.follow(jax.random.key(seed + 100), len(SEEN))}
        draws = np.concatenate([paths[t] for t in range(len(SEEN))], axis=1)
        np.testing.assert_allclose(draws.mean(axis=0), mean, atol=5e-3)
        off = np.abs(np.cov(draws.T, bias=True) - covariance)
        # The noise of a frame has exact moments, none of them with the next frame. Frames further apart are left to chance.
        assert off[apart < 2].max() < 2e-3 and off.max() < 0.08


@pytest.mark.slow
def test_those_of_all_runs_together_are_those_of_each_run():
    """In pieces of several frames; one run starts anew on the way. From any frame they go on to the same numbers."""
    runs, count, paths, transition = 2, 20, 30, _turning(0, None).transition
    x = np.random.default_rng(4).normal(size=(count, runs, 50, 2)).astype(np.float32)
    weights = np.full((runs, 50), -np.log(50), np.float32)
    restarted = [np.array([frame == 7, False]) if frame % 2 else np.zeros(0, bool) for frame in range(count)]
    results = [FrameResult({"x": x[t]}, weights, None, np.zeros(0, bool), 0.0, restarted=restarted[t]) for t in range(count)]
    keys = [jax.random.key(run) for run in range(runs)]
    pieces = list(gaussian_pieces(keys, transition, paths, results.__getitem__, count))
    found = np.concatenate([piece.states["x"] for piece in pieces], axis=1)[:, ::-1]
    for run in range(runs):
        frames = [
            Filtered(Particles({"x": jnp.asarray(x[t, run])}, jnp.asarray(weights[run])), None, t == 0 or (run == 0 and t == 7)) for t in range(count)
        ]
        walk = Backward(build_smoother(draws=paths, start="gaussian", moves=0), transition, lambda t, frames=frames: frames[t], _turning)
        alone = {one.frame: np.asarray(one.states["x"]) for one in walk.follow(keys[run], count)}
        np.testing.assert_allclose(found[run], np.stack([alone[t] for t in range(count)]), rtol=1e-3, atol=1e-3)
    for first in (6, 7, 12):
        again = gaussian_pieces(keys, transition, paths, results.__getitem__, first, {"x": found[:, first]})
        np.testing.assert_array_equal(np.concatenate([piece.states["x"] for piece in again], axis=1)[:, ::-1], found[:, :first])


def test_they_need_quantiles_and_one_frame_of_memory():
    particles = SECOND.start(jax.random.key(0), 40)
    frames = [Filtered(particles, jnp.zeros(40, jnp.int32), frame == 0) for frame in range(2)]
    walk = Backward(build_smoother(draws=10, start="gaussian", moves=0), SECOND.transition, lambda t: frames[t], SECOND.density)
    with pytest.raises(InputError, match="start: gaussian: the dynamics 'process' depend on more than one frame, or have no quantiles"):
        walk.follow(jax.random.key(0), 2)
