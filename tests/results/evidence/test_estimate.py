"""The evidence of runs against closed forms: two linear Gaussian models whose evidence a Kalman filter gives, and log-normal estimates."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from closed_forms.conftest import linear_gaussian, observations  # noqa: F401

from bayes_body.kernels.smc.particle_filter import build_kernel
from bayes_body.results.evidence.estimate import difference, estimate

RUNS, REPEATS, PARTICLES = 4, 40, 6000


def _log_evidence(model, ys, seed):
    """The particle filter's log-evidence of each frame: (repeat, run, frame)."""
    kernel = build_kernel()

    def once(key):
        def frame(particles, step):
            number, y = step
            particles, info = kernel(jax.random.fold_in(key, number), particles, model.density(y, particles))
            return particles, info.log_evidence

        return jax.lax.scan(frame, model.start(jax.random.fold_in(key, 99), PARTICLES), (jnp.arange(len(ys)), jnp.asarray(ys)))[1]

    runs = jax.jit(lambda keys: jax.lax.map(once, keys))(jax.random.split(jax.random.key(seed), RUNS * REPEATS))
    return np.asarray(runs, float).reshape(REPEATS, RUNS, len(ys))


@pytest.mark.slow
def test_the_interval_of_two_linear_gaussian_models_holds_the_kalman_filters_difference(linear_gaussian, observations):  # noqa: F811
    slower = linear_gaussian._replace(A=0.6 * linear_gaussian.A)
    exact = np.cumsum(linear_gaussian.kalman(observations)[2] - slower.kalman(observations)[2])
    pairs = zip(_log_evidence(linear_gaussian, observations, 0), _log_evidence(slower, observations, 1), strict=True)
    leads = [difference(estimate(first), estimate(second)) for first, second in pairs]
    low, high, value, error = (np.array([getattr(lead, name) for lead in leads]) for name in ("low", "high", "value", "error"))
    # The models differ by far more than the error of one repetition, and the errors are those that the repetitions show.
    assert abs(exact[-1]) > 1 and np.median(error[:, -1]) < 1
    assert 0.5 < np.median(error[:, -1]) / value[:, -1].std(ddof=1) < 2
    assert np.abs(value.mean(axis=0) - exact).max() < 4 * value.std(axis=0, ddof=1).max() / np.sqrt(REPEATS)
    # Of 40 intervals of 95 %, fewer than 34 hold the truth once in 80 000 times.
    assert ((low <= exact) & (exact <= high)).sum(axis=0).min() >= 34


@pytest.mark.slow
@pytest.mark.parametrize(("sd", "runs", "least"), [(0.3, 3, 0.92), (1.0, 3, 0.88), (2.0, 5, 0.83)])
def test_the_interval_of_log_normal_estimates_holds_the_truth(sd, runs, least):
    """Of normal log-evidences with the mean of an unbiased estimate; a bootstrap's or a jackknife's interval holds it in 0.76 with 5 runs, sd 2."""
    rng, repeats = np.random.default_rng(0), 4000
    drawn = rng.normal(-(sd**2) / 2, sd, (2, repeats, runs, 1))
    leads = [difference(estimate(first), estimate(second)) for first, second in zip(*drawn, strict=True)]
    assert np.mean([lead.low[-1] <= 0 <= lead.high[-1] for lead in leads]) > least


def test_the_estimate_is_the_logarithm_of_the_mean_over_the_runs():
    by_frame = np.log([[1.0, 2.0], [3.0, 1.0], [2.0, 4.0]])
    found = estimate(by_frame)
    assert np.allclose(found.value, np.log([2.0, (2 + 3 + 8) / 3])) and found.runs == 3
    # What all frames have in common changes no difference, and nothing but the number of frames changes the value.
    shifted = difference(estimate(by_frame - 1000.0), estimate(by_frame - 1000.0))
    assert np.allclose(shifted.value, 0) and np.allclose(shifted.low, -shifted.high) and np.all(shifted.high > 0)


def test_one_run_has_no_error_and_a_lost_frame_no_bound():
    single = estimate(np.zeros((1, 2)))
    assert single.value.tolist() == [0, 0] and np.isnan(single.error).all() and np.isnan(difference(single, single).low).all()
    lost = estimate(np.array([[0.0, -np.inf], [0.0, -1.0]]))
    assert lost.error[0] == 0 and np.isinf(lost.error[1]) and np.isclose(lost.value[1], -1 - np.log(2))
    lead = difference(lost, estimate(np.zeros((2, 2))))
    assert lead.low[0] == lead.high[0] == 0 and lead.low[1] == -np.inf and lead.high[1] == np.inf
    never = difference(estimate(np.full((2, 1), -np.inf)), estimate(np.zeros((2, 1))))
    assert np.isnan(never.value[0]) and never.low[0] == -np.inf
