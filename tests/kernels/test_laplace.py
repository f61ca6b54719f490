"""The kernel `laplace` and its parts: exact on a Gaussian, right on a skewed target, and every part of it is needed."""

from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import numpyro.distributions as dist
import pytest

from bayes_body.density.density import Density
from bayes_body.density.expansion import expand, without_negative
from bayes_body.density.factor import Composed, Factor, Particles, Transition, Variable
from bayes_body.kernels.laplace import laplace_filter, proposal
from bayes_body.kernels.laplace.laplace_filter import build_kernel
from bayes_body.kernels.laplace.pareto import pareto_shape
from bayes_body.kernels.smc import moment_correction
from bayes_body.results.posterior import pareto

X = Variable("x")
DOFS, COUNT, SCALE = 3, 256, 1.0
partial = jax.tree_util.Partial


def _step(previous):
    return {"x": dist.Normal(previous["x"], 1.0).to_event(1)}


def _noise(state, scale):
    return {"x": dist.Normal(state["x"], scale).to_event(1)}


def _inner(matrix, values):
    return (matrix @ values[X])[:, None]


def _gaussian(rows, data):
    return -0.5 * ((rows[:, 0] - data) / 0.3) ** 2


def _gumbel(rows, data):
    """Skewed: of the last row nothing is seen."""
    off = (rows[:, 0] - data) / SCALE
    return jnp.where(jnp.arange(len(rows)) < len(rows) - 1, off - jnp.exp(off), 0.0)


def density(outer=_gaussian, y=(0.4, -0.2, 0.7), matrix=None):
    """One frame of a random walk of three entries, from a single point."""
    matrix = jnp.asarray(np.eye(DOFS) if matrix is None else matrix, jnp.float32)
    factor = Factor("y", "likelihood", (X,), Composed(partial(_inner, matrix), partial(outer)))
    start = Particles({"x": jnp.zeros((COUNT, DOFS))}, jnp.full(COUNT, -jnp.log(COUNT)))
    return Density(Transition("walk", partial(_step), partial(_noise)), (factor,), {"y": jnp.asarray(y)}, start)


def run(target, key=0, **options):
    particles, info = build_kernel(fallback="none", **options)(jax.random.key(key), target.previous, target)
    weights, x = np.exp(np.asarray(particles.log_weights, float)), np.asarray(particles.states["x"], float)
    mean = weights @ x
    return SimpleNamespace(mean=mean, covariance=(x - mean).T @ ((x - mean) * weights[:, None]), info=info)


def check_gaussian(key=0):
    matrix = np.array([[1.0, 0.5, 0.0], [0.0, 1.0, -1.0]])
    result = run(density(y=(0.4, -0.2), matrix=matrix), key)
    covariance = np.linalg.inv(np.eye(DOFS) + matrix.T @ matrix / 0.3**2)
    marginal = matrix @ matrix.T + 0.3**2 * np.eye(2)
    y = np.array([0.4, -0.2])
    # The likelihood has no constant here.
    evidence = -0.5 * (y @ np.linalg.solve(marginal, y) + np.linalg.slogdet(marginal / 0.3**2)[1])
    np.testing.assert_allclose(result.mean, covariance @ matrix.T @ y / 0.3**2, atol=2e-3)
    np.testing.assert_allclose(result.covariance, covariance, atol=2e-3)
    np.testing.assert_allclose(result.info.log_evidence, evidence, atol=2e-3)
    assert result.info.ess > 0.999 * COUNT and int(result.info.modes["attempt"]) == 0


@pytest.mark.parametrize("key", range(3))
def test_of_a_gaussian_everything_is_exact_whatever_the_draws(key):
    check_gaussian(key)


# What a kernel must not leave out: each of them is noticed by the exact answers above.
@pytest.mark.slow
def test_outer_curvature_without_its_sign_is_found_out(monkeypatch):
    monkeypatch.setattr("bayes_body.density.expansion.without_negative", lambda matrices: without_negative(-matrices))
    with pytest.raises(AssertionError):
        check_gaussian()


@pytest.mark.slow
def test_weights_without_the_density_of_the_proposal_are_found_out(monkeypatch):
    honest = proposal.draw
    monkeypatch.setattr(laplace_filter, "draw", lambda *given: (draws := honest(*given)) and (draws[0], jnp.zeros_like(draws[1])))
    with pytest.raises(AssertionError):
        check_gaussian()


@pytest.mark.slow
def test_draws_without_exact_moments_are_found_out(monkeypatch):
    def pairs(normal, count):
        return jnp.concatenate([normal, -normal])

    # With the correction by slopes the moments of a Gaussian would be exact even so.
    unchanged = lambda draws, log_weights, slopes: moment_correction.moments(draws, log_weights)  # noqa: E731
    monkeypatch.setattr(laplace_filter, "corrected_moments", unchanged)
    check_gaussian()
    monkeypatch.setattr(proposal, "balanced", pairs)
    with pytest.raises(AssertionError):
        check_gaussian()


def by_quadrature(y):
    """Mean, variance and log-evidence of one entry of the skewed target."""
    x = np.linspace(-8, 8, 20001)
    off = (x - y) / SCALE
    log_density = off - np.exp(off) - 0.5 * x**2 - 0.5 * np.log(2 * np.pi)
    density = np.exp(log_density)
    total = np.trapezoid(density, x)
    mean = np.trapezoid(density * x, x) / total
    return mean, np.trapezoid(density * (x - mean) ** 2, x) / total, np.log(total)


def skewed_means(keys):
    def one(key):
        target = density(_gumbel)
        particles, info = build_kernel(fallback="none")(key, target.previous, target)
        w, x = jnp.exp(particles.log_weights), particles.states["x"]
        mean = w @ x
        return mean, w @ (x - mean) ** 2, info.log_evidence

    return [np.asarray(values, float) for values in jax.jit(lambda keys: jax.lax.map(one, keys))(jax.random.split(jax.random.key(5), keys))]


def check_skewed():
    keys = 400
    means, variances, evidences = skewed_means(keys)
    mean, variance, log_evidence = np.array([by_quadrature(0.4), by_quadrature(-0.2)]).T
    relative = (means[:, :2] - mean) / np.sqrt(variance), variances[:, :2] / variance - 1, np.exp(evidences - log_evidence.sum())[:, None] - 1
    # Of so few draws the moments have a bias, which is larger the more skewed the target.
    for off, bias in zip(relative, (0.01, 0.015, 0.005), strict=True):
        assert (np.abs(off.mean(axis=0)) < bias + 4.5 * off.std(axis=0, ddof=1) / np.sqrt(keys)).all()
    # The entry that nothing sees keeps the moments of the prediction in every single run. They would drift from frame to frame otherwise.
    assert np.abs(means[:, 2]).max() < 2e-2 and np.abs(variances[:, 2] - 1).max() < 4e-2


def test_of_a_skewed_target_moments_and_evidence_are_those_of_quadrature():
    check_skewed()


@pytest.mark.slow
def test_a_second_attempt_that_finds_no_other_mode_keeps_the_draws_of_the_first():
    """Its own draws come from a mixture, in which few weights count."""
    target = density(_gumbel)
    first, second = (run(target, moments="slopes", most_k=99.0, least_ess=least) for least in (1e-6, 0.999))
    assert (int(first.info.modes["attempt"]), int(second.info.modes["attempt"])) == (0, 1)
    np.testing.assert_allclose(second.mean, first.mean, atol=1e-6)
    np.testing.assert_allclose(second.covariance, first.covariance, atol=1e-6)
    # With weights, the second attempt has its own.
    other = run(target, moments="weights", most_k=99.0, least_ess=0.999)
    assert np.abs(other.mean - first.mean).max() > 1e-4


@pytest.mark.slow
def test_slopes_left_out_are_found_out(monkeypatch):
    monkeypatch.setattr(laplace_filter, "corrected_moments", lambda draws, log_weights, slopes: moment_correction.moments(draws, log_weights))
    with pytest.raises(AssertionError):
        check_skewed()


def _two_modes(rows, data):
    """Of the first entry either +data or -data is seen, as a limb may be bent either way."""
    return jnp.where(jnp.arange(len(rows)) == 0, jnp.logaddexp(-0.5 * ((rows[:, 0] - data) / 0.1) ** 2, -0.5 * ((rows[:, 0] + data) / 0.1) ** 2), 0.0)


def test_several_starts_find_both_modes():
    target = density(_two_modes, y=(1.5, 0.0, 0.0))
    both = run(target, starts=8)
    assert int(both.info.modes["modes"]) == 2
    assert abs(both.mean[0]) < 0.3 and both.covariance[0, 0] > 1.8
    # A single start sees one mode and nothing that tells of the other.
    single = run(target, key=1)
    assert single.covariance[0, 0] < 0.1 or int(single.info.modes["attempt"]) > 0


@pytest.mark.slow
def test_a_frame_that_importance_sampling_cannot_do_is_done_by_tempering():
    def peaked(rows, data):
        # A narrow peak on heavy tails, which have most of the mass: the Gaussian at the mode is far too narrow.
        return -0.6 * jnp.log1p(((rows[:, 0] - data) / 0.003) ** 2)

    target = density(peaked, y=(0.5, 0.0, -0.5))
    failed = run(target)
    assert int(failed.info.modes["attempt"]) == 1 and (float(failed.info.modes["pareto_k"]) > 0.7 or float(failed.info.ess) < 0.1 * COUNT)
    particles, info = build_kernel()(jax.random.key(0), target.previous, target)
    assert int(info.modes["attempt"]) == 2 and np.isfinite(float(info.log_evidence)) and np.isfinite(np.asarray(particles.states["x"])).all()


def test_the_tail_of_the_weights_is_that_of_the_diagnostics():
    rng = np.random.default_rng(3)
    sets = [rng.normal(size=400) * scale for scale in (0.1, 1.0, 3.0)] + [np.zeros(400), np.r_[np.zeros(399), 50.0]]
    for log_weights in sets:
        inside, outside = float(pareto_shape(jnp.asarray(log_weights, jnp.float32))), float(pareto.pareto_shape(log_weights.astype(np.float32)))
        # In a program, a tail of equal weights has no shape.
        np.testing.assert_allclose(inside, np.nan if outside == -np.inf else outside, atol=2e-3)


@pytest.mark.slow
def test_composed_and_plain_factors_have_the_same_expansion():
    composed = density(matrix=np.array([[1.0, 0.5, 0.0], [0.0, 1.0, -1.0], [0.3, 0.0, 0.2]]))
    (factor,) = composed.factors
    plain = Density(composed.transition, (Factor("y", "likelihood", (X,), partial(factor.log_potential)),), composed.data, composed.previous)
    at = jnp.array([0.1, -0.4, 0.2])
    for one, other in zip(*(expand(each, lambda x: {"x": x}, at) for each in (composed, plain)), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("size", [1, 2, 3])
def test_negative_eigenvalues_are_left_out(size):
    matrices = np.random.default_rng(size).normal(size=(20, size, size))
    matrices = jnp.asarray(matrices + np.swapaxes(matrices, 1, 2), jnp.float32)
    values, vectors = np.linalg.eigh(np.asarray(matrices, float))
    expected = (vectors * np.maximum(values, 0)[:, None]) @ np.swapaxes(vectors, 1, 2)
    np.testing.assert_allclose(without_negative(matrices), expected, atol=1e-4)
