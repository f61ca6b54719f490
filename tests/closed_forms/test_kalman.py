"""The particle filter against the Kalman filter: means, covariances and evidence, within four Monte Carlo standard errors over five keys."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from bayes_body.kernels.smc import particle_filter
from bayes_body.kernels.smc.particle_filter import build_kernel

# These programs run for longer than they compile.
pytestmark = pytest.mark.usefixtures("optimised")

# The means of five keys are tested; the spread of one frame's estimate is known well enough only from more.
KEYS, SPREAD_KEYS, PARTICLES = 5, 25, 8000


def _filters(model, ys, kernel):
    """Means, covariances and log-evidences: each (key, frame, ...)."""
    step = jax.jit(lambda k, particles, y: kernel(k, particles, model.density(y, particles)))

    def one(key):
        particles, out = model.start(jax.random.fold_in(key, 99), PARTICLES), []
        for frame, y in enumerate(ys):
            particles, info = step(jax.random.fold_in(key, frame), particles, jnp.asarray(y))
            w, x = np.exp(np.asarray(particles.log_weights, float)), np.asarray(particles.states["x"], float)
            mean = w @ x
            out.append((mean, (x - mean).T @ ((x - mean) * w[:, None]), float(info.log_evidence)))
        return [np.array(column) for column in zip(*out, strict=True)]

    return [np.array(column) for column in zip(*(one(jax.random.key(seed)) for seed in range(SPREAD_KEYS)), strict=True)]


def _check_against_kalman(model, ys, kernel):
    exact = model.kalman(ys)
    runs = _filters(model, ys, kernel)
    for k, name in enumerate(("mean", "covariance", "log-evidence")):
        mcse = runs[k].std(axis=0, ddof=1) / np.sqrt(KEYS)
        distance = np.abs(runs[k][:KEYS].mean(axis=0) - exact[k]) / mcse
        assert distance.max() < 4, f"{name}: {distance.max():.1f} MCSE from the Kalman filter"


@pytest.mark.parametrize(
    "scheme", ["systematic", *(pytest.param(scheme, marks=pytest.mark.long) for scheme in ("stratified", "multinomial", "residual"))]
)
def test_sir_equals_the_kalman_filter(linear_gaussian, observations, scheme):
    _check_against_kalman(linear_gaussian, observations, build_kernel(scheme))


@pytest.mark.slow
def test_a_filter_that_forgets_the_weights_is_found_out(linear_gaussian, observations, monkeypatch):
    monkeypatch.setattr(particle_filter, "resampler", lambda scheme: lambda key, log_weights: jnp.arange(log_weights.shape[0]))
    with pytest.raises(AssertionError, match="MCSE from the Kalman filter"):
        _check_against_kalman(linear_gaussian, observations, build_kernel())


@pytest.mark.slow
def test_a_filter_that_keeps_its_weights_after_resampling_is_found_out(linear_gaussian, observations):
    honest = build_kernel()

    def twice_weighted(key, particles, density):
        after, info = honest(key, particles, density)
        carried = after.log_weights + particles.log_weights[info.ancestors]
        return after._replace(log_weights=carried - jax.nn.logsumexp(carried)), info

    with pytest.raises(AssertionError, match="MCSE from the Kalman filter"):
        _check_against_kalman(linear_gaussian, observations, twice_weighted)


@pytest.mark.long
def test_the_error_falls_with_the_root_of_the_particles(linear_gaussian, observations):
    """The slope of log error over log N is -1/2, within four of its standard errors, once N is large enough for the data's outlier."""
    exact, kernel, sizes, keys = linear_gaussian.kalman(observations)[0], build_kernel(), (4000, 64_000), 60
    step = jax.jit(lambda key, particles, y: kernel(key, particles, linear_gaussian.density(y, particles)))

    def squared_error(size, seed):
        key, total = jax.random.key(seed), 0.0
        particles = linear_gaussian.start(jax.random.fold_in(key, 99), size)
        for frame, y in enumerate(observations):
            particles, _ = step(jax.random.fold_in(key, frame), particles, jnp.asarray(y))
            mean = np.exp(np.asarray(particles.log_weights, float)) @ np.asarray(particles.states["x"], float)
            total += float(((mean - exact[frame]) ** 2).sum())
        return total

    errors = np.array([[squared_error(size, seed) for seed in range(keys)] for size in sizes])
    log_rmse, octaves = 0.5 * np.log(errors.mean(axis=1)), np.log(sizes[1] / sizes[0])
    # By the delta method, from the spread of the squared errors over keys.
    se = 0.5 * errors.std(axis=1, ddof=1) / errors.mean(axis=1) / np.sqrt(keys)
    slope_se = np.hypot(*se) / octaves
    assert slope_se < 0.05
    assert abs((log_rmse[1] - log_rmse[0]) / octaves + 0.5) < 4 * slope_se


@pytest.mark.slow
def test_the_evidence_is_unbiased(linear_gaussian, observations):
    """E[Z_hat] = Z for any number of particles: here few, many times."""
    ys, kernel, runs = observations[:3], build_kernel(), 400
    exact = linear_gaussian.kalman(ys)[2].sum()

    def once(key):
        def frame(particles, step):
            number, y = step
            particles, info = kernel(jax.random.fold_in(key, number), particles, linear_gaussian.density(y, particles))
            return particles, info.log_evidence

        start = linear_gaussian.start(jax.random.fold_in(key, 99), 200)
        return jnp.sum(jax.lax.scan(frame, start, (jnp.arange(len(ys)), jnp.asarray(ys)))[1])

    # One after the other: the kernel spreads its own particles over the devices.
    ratios = np.exp(np.asarray(jax.lax.map(once, jax.random.split(jax.random.key(3), runs)), float) - exact)
    assert ratios.std() < 0.7
    assert abs(ratios.mean() - 1) < 3 * ratios.std(ddof=1) / np.sqrt(runs)
