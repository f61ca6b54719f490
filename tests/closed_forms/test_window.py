"""NUTS on a window of frames, and sweeps over overlapping windows, against the exact smoothers of linear Gaussian processes."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from closed_forms import window_sweep
from closed_forms.processes import BEFORE, FIRST, SECOND, SEEN, distance
from closed_forms.window_sweep import LongPath, sweep, windows_of

from bayes_body.base.errors import InputError
from bayes_body.density.factor import Particles
from bayes_body.density.trajectory import trajectory
from bayes_body.kernels.paths.window import fitted_path, gaussian_path, sample_window
from bayes_body.kernels.paths.window_nuts import chain_diagnostics
from bayes_body.kernels.smc.moves import hmc

FRAMES, FAULT = len(SEEN), "standard errors from the exact smoother"
# By default NUTS with one of both.
NUTS = [pytest.param(FIRST, id="first order", marks=pytest.mark.slow), pytest.param(SECOND, id="second order")]
SWEEPS = [pytest.param(FIRST, id="first order"), pytest.param(SECOND, id="second order")]


def _origin(process):
    """One particle, at the origin, for which the smoother's equations hold exactly."""
    x = jnp.zeros((1, 2))
    return Particles({"x": x} | ({BEFORE: x} if process.memory == 2 else {}), jnp.zeros(1))


def _paths(process, count, scale=1.0):
    """Paths about the exact ones, wider by `scale`."""
    mean, covariance = process.exact(np.zeros((2, 2)))
    rng = np.random.default_rng(0)
    x = (mean + scale * rng.standard_normal((count, len(mean))) @ np.linalg.cholesky(covariance).T).reshape(count, FRAMES, 2)
    earlier = np.concatenate([np.zeros((count, 1, 2)), x[:, :-1]], axis=1)
    return {name: jnp.asarray(values, float) for name, values in ({"x": x} | ({BEFORE: earlier} if process.memory == 2 else {})).items()}


def _target(process):
    return trajectory(process.frames(), _origin(process), jax.tree.map(lambda leaf: leaf[0], _paths(process, 1)))


@pytest.mark.slow
@pytest.mark.parametrize("metric", ["diagonal", pytest.param("dense", marks=pytest.mark.long), pytest.param("low_rank", marks=pytest.mark.long)])
@pytest.mark.parametrize("process", NUTS)
def test_nuts_on_a_window_is_the_exact_smoother(process, metric):
    found = sample_window(jax.random.key(3), _target(process), _paths(process, 40, 2.0), warm_up=200, draws=400, metric=metric)
    assert np.max(found.r_hat) <= 1.01 and not np.any(found.divergent) and np.min(found.effective) > 1000
    draws = np.asarray(found.states["x"], float).reshape(-1, 2 * FRAMES)
    mean, covariance = process.exact(np.zeros((2, 2)))
    sd, effective = np.sqrt(np.diag(covariance)), np.asarray(found.effective).min()
    assert np.abs(draws.mean(axis=0) - mean).max() < 4 * sd.max() / np.sqrt(effective)
    # NUTS knows squares less well than means. The standard error of a covariance is at most sqrt(2) in units of both spreads.
    squares = np.min(chain_diagnostics(jnp.asarray((np.asarray(found.states["x"], float) - mean.reshape(FRAMES, 2)) ** 2, float))[1])
    assert (np.abs(np.cov(draws.T) - covariance) / np.outer(sd, sd)).max() < 4 * np.sqrt(2 / squares)


def _swept(process, sweeps=40, count=800):
    """Means and covariances of 16 groups of paths after some sweeps; all paths start from their means."""
    frames, before, move = process.frames(), process.start(jax.random.key(5), 50), hmc(4)
    paths = _paths(process, 40)
    reference = jax.tree.map(lambda leaf: leaf[0], paths)
    windows = windows_of(fitted_path(trajectory(frames, before, reference), paths), 3, move)

    @jax.jit
    def run(key):
        start = LongPath({"x": jnp.zeros((count, FRAMES, 2))}, jnp.zeros(count, int))

        def one(paths, key):
            return sweep(key, paths, frames, before, reference, windows, move)

        return jax.lax.scan(one, start, jax.random.split(key, sweeps))

    paths, rates = run(jax.random.key(6))
    assert rates.shape == (sweeps, 4) and np.min(rates) > 0.5
    groups = np.asarray(paths.sampled["x"], float).reshape(16, -1, 2 * FRAMES)
    # The particles before the first frame are few: their own mean and covariance stand for those of the first state.
    x = np.asarray(before.states["x"], float)
    return groups, x


def check_sweeps(process):
    groups, first = _swept(process)
    exact = process.exact_after(first)
    for name, given, found in zip(
        ("mean", "second moment"), exact, (groups.mean(axis=1), np.einsum("gpi,gpj->gij", groups, groups) / groups.shape[1]), strict=True
    ):
        assert distance(given, found) < 4.5, f"{name}: {distance(given, found):.1f} {FAULT}"


@pytest.mark.slow
@pytest.mark.parametrize("process", SWEEPS)
def test_sweeps_over_windows_lead_to_the_exact_smoother(process):
    check_sweeps(process)


@pytest.mark.slow
def test_windows_that_ignore_the_frames_after_them_are_found_out(monkeypatch):
    ahead = window_sweep.Ahead
    monkeypatch.setattr(window_sweep, "Ahead", lambda sampled, known: ahead(sampled, jnp.zeros_like(known)))
    with pytest.raises(AssertionError, match=FAULT):
        check_sweeps(FIRST)


def test_the_fitted_process_has_the_covariance_of_the_paths():
    _, covariance = SECOND.exact(np.zeros((2, 2)))
    paths = np.random.default_rng(1).standard_normal((20_000, 2 * FRAMES)) @ np.linalg.cholesky(covariance).T
    root = np.asarray(gaussian_path(paths.reshape(-1, FRAMES, 2), 2).whitening().root, float)
    white = np.linalg.solve(root, np.linalg.cholesky(covariance))
    # Residuals are shrunk by a tenth towards their diagonal.
    assert np.abs(white @ white.T - np.eye(len(white))).max() < 0.15


def test_wrong_numbers_are_refused():
    with pytest.raises(InputError, match="the paths: 3; expected one for each of the 4 chains"):
        sample_window(jax.random.key(0), _target(FIRST), _paths(FIRST, 3))
    with pytest.raises(InputError, match="frames of a window: 7; expected a whole number from 1 to 6"):
        windows_of(fitted_path(_target(FIRST), _paths(FIRST, 20)), 7, hmc(4))
