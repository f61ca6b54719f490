"""Tempered SMC with a Gaussian prediction: the Kalman filter where that is exact, and runs that agree where particles' ancestors do not let them."""

import jax
import jax.numpy as jnp
import numpy as np
import numpyro.distributions as dist
import pytest
from closed_forms.conftest import POSITION, LinearGaussian

from bayes_body.density.density import Density
from bayes_body.density.factor import Factor, Particles, Transition, Variable
from bayes_body.kernels.smc import tempering
from bayes_body.kernels.smc.tempered_smc import build_kernel

OPTIONS = {"prediction": "gaussian", "moves": 1, "target_ess": 0.3, "final_stages": 4}


def _filtered(kernel, density, first, ys, keys):
    """Means, covariances and log-evidences of each frame: (key, frame, ...)."""

    def one(key):
        def frame(particles, step):
            number, y = step
            after, info = kernel(jax.random.fold_in(key, number), particles, density(y, particles))
            w, x = jnp.exp(after.log_weights), jnp.concatenate([after.states[name] for name in ("x", "v") if name in after.states], axis=1)
            mean = w @ x
            return after, (mean, (x - mean).T @ ((x - mean) * w[:, None]), info.log_evidence)

        return jax.lax.scan(frame, first(jax.random.fold_in(key, 99)), (jnp.arange(len(ys)), jnp.asarray(ys, jnp.float32)))[1]

    found = jax.jit(lambda keys: jax.lax.map(one, keys))(jax.random.split(jax.random.key(2), keys))
    return [np.asarray(values, float) for values in found]


def _check_against_kalman(model, ys):
    first = lambda key: jax.tree.map(lambda leaf: leaf.astype(jnp.float32), model.start(key, 240))  # noqa: E731
    runs, exact = _filtered(build_kernel(**OPTIONS), model.density, first, ys, 60), model.kalman(ys)
    for name, found, expected in zip(("mean", "covariance", "log-evidence"), runs, exact, strict=True):
        off = np.abs(found.mean(axis=0) - expected) / (found.std(axis=0, ddof=1) / np.sqrt(len(found)))
        assert off.max() < 4.5, f"{name}: {off.max():.1f} standard errors from the Kalman filter"


@pytest.mark.slow
def test_on_a_gaussian_model_it_is_the_kalman_filter(linear_gaussian, observations):
    _check_against_kalman(linear_gaussian, observations)


class Moving(LinearGaussian):
    """The two coordinates are two variables, a position and a velocity, with independent noise. Only the position is seen."""

    def density(self, y, previous):
        arguments = (jnp.asarray(self.A), jnp.diagonal(jnp.asarray(self.Q_root)))
        transition = Transition("moving", jax.tree_util.Partial(_moving, *arguments), jax.tree_util.Partial(_moving, jnp.eye(2), arguments[1]))
        factor = Factor("y", "likelihood", (POSITION,), jax.tree_util.Partial(_at, jnp.asarray(self.R_sd)))
        return Density(transition, (factor,), {"y": jnp.asarray(y)}, previous)

    def start(self, key, count):
        particles = super().start(key, count)
        both = particles.states["x"]
        return Particles({"x": both[:, :1], "v": both[:, 1:]}, particles.log_weights)


def _moving(A, sd, state, scale=1.0):
    both = A @ jnp.concatenate([state["x"], state["v"]])
    return {"x": dist.Normal(both[:1], scale * sd[:1]).to_event(1), "v": dist.Normal(both[1:], scale * sd[1:]).to_event(1)}


def _at(sd, values, y):
    return jnp.sum(dist.Normal(values[POSITION], sd).log_prob(y))


@pytest.mark.slow
def test_variables_that_no_factor_reads_are_those_of_the_kalman_filter_too(observations):
    A, H = np.array([[1.0, 1.0], [-0.2, 0.9]]), np.array([[1.0, 0.0]])
    _check_against_kalman(Moving(A, np.diag([0.3, 0.5]), H, 0.4, np.array([0.5, -1.0]), np.diag([1.0, 0.7])), observations)


@pytest.mark.long
@pytest.mark.parametrize("share", [-1.0, 0.7])
def test_a_wrong_slope_is_found_out(linear_gaussian, observations, monkeypatch, share):
    honest = tempering.corrected_moments
    monkeypatch.setattr(tempering, "corrected_moments", lambda draws, log_weights, slopes: honest(draws, log_weights, share * slopes))
    with pytest.raises(AssertionError, match="standard errors from the Kalman filter"):
        _check_against_kalman(linear_gaussian, observations)


# The variances of the noise with which the dofs of a random walk are seen, relative to those of a step. The last two are as good as unseen.
SEEN = np.array([0.3, 0.3, 1.0, 1.0, 1.0, 1.0, 30.0, 30.0, 1e6, 1e6], np.float32)


def _step(previous):
    return {"x": dist.Normal(previous["x"], 1.0).to_event(1)}


def _noise(state, scale):
    return {"x": dist.Normal(state["x"], scale).to_event(1)}


def _look(values, y):
    return jnp.sum(dist.Normal(values[POSITION], jnp.sqrt(SEEN)).log_prob(y))


def _random_walk(y, previous):
    factor = Factor("y", "likelihood", (POSITION,), jax.tree_util.Partial(_look))
    return Density(Transition("walk", jax.tree_util.Partial(_step), jax.tree_util.Partial(_noise)), (factor,), {"y": y}, previous)


@pytest.mark.long
def test_runs_agree_about_dofs_that_are_hardly_seen():
    """Independent draws that a run is worth, in the second half of forty frames: the variance of the posterior over that of the runs' means."""
    rng = np.random.default_rng(4)
    ys = np.cumsum(rng.standard_normal((40, len(SEEN))), axis=0) + np.sqrt(SEEN) * rng.standard_normal((40, len(SEEN)))
    first = Particles({"x": jnp.zeros((200, len(SEEN)))}, jnp.full(200, -jnp.log(200.0)))
    worth = {}
    for prediction in ("particles", "gaussian"):
        means, covariances, _ = _filtered(build_kernel(**OPTIONS | {"prediction": prediction}), _random_walk, lambda key: first, ys, 6)
        variance = np.diagonal(covariances, axis1=2, axis2=3).mean(axis=0) + means.var(axis=0)
        worth[prediction] = 1 / (means.var(axis=0, ddof=1) / variance)[20:].mean(axis=0)
    assert worth["particles"][6:].max() < 15
    assert worth["gaussian"].min() > 20 and worth["gaussian"][:6].min() > 500


def _remembered(previous, known):
    return {**known, "before": previous["x"]}


def test_dynamics_with_a_longer_memory_are_refused(linear_gaussian):
    previous = linear_gaussian.start(jax.random.key(0), 20)
    density = linear_gaussian.density(np.array([0.4]), previous)
    transition = density.transition
    longer = Transition("second_order", transition.conditional, transition.perturbation, carry=jax.tree_util.Partial(_remembered))
    kernel = build_kernel(**OPTIONS)
    with pytest.raises(ValueError, match=r"the dynamics 'second_order' carry more along .* --set prediction=particles"):
        kernel(jax.random.key(0), previous, Density(longer, density.factors, density.data, previous))
    compared = Factor("flow", "likelihood", (POSITION, Variable("x", -1)), jax.tree_util.Partial(_look))
    with pytest.raises(ValueError, match="'flow' compares a frame with the frame before"):
        kernel(jax.random.key(0), previous, Density(transition, (compared,), {}, previous))
