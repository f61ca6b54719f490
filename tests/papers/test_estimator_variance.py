"""Estimator variance on posteriors in closed form: the truth is found, and a sampler of n independent draws has the error of n."""

from types import SimpleNamespace

import computation_curve
import cv2
import equal_computation as ev
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import true_mean
from closed_forms.targets import conjugate

from bayes_body.density.factor import Factor, Particles, Transition, Variable
from bayes_body.density.kernel import FilterInfo

POSE = Variable("pose")


def _density():
    """The conjugate target, its variable called `pose`."""
    made = conjugate(8)
    density = made.density
    renamed = {
        "conditional": lambda before: {"pose": density.transition.conditional({"x": before["pose"]})["x"]},
        "perturbation": lambda state, scale: {"pose": density.transition.perturbation({"x": state["pose"]}, scale)["x"]},
    }
    transition = Transition("gaussian", *(jax.tree_util.Partial(each) for each in renamed.values()))
    (seen,) = density.factors
    factor = Factor(
        "seen", "likelihood", (POSE,), jax.tree_util.Partial(lambda values, data: seen.log_potential({Variable("x"): values[POSE]}, data))
    )
    previous = Particles({"pose": density.previous.states["x"]}, density.previous.log_weights)
    return type(density)(transition, (factor,), density.data, previous), made.mean


@pytest.fixture(scope="module")
def target():
    return _density()


def _independent(mean, sd, number):
    """A sampler of independent draws of a normal law."""

    def sample(key, density):
        pose = mean + sd * jax.random.normal(key, (number, 3))
        unknown = jnp.zeros(())
        info = FilterInfo(unknown, unknown, unknown, unknown, unknown, unknown, unknown, jnp.asarray(number))
        return Particles({"pose": pose}, jnp.full(number, -jnp.log(number))), info

    return sample


def test_the_truth_is_the_posteriors_mean(target, monkeypatch):
    monkeypatch.setattr(true_mean, "CHUNK", 20_000)
    density, mean = target
    truth = true_mean.true_mean(jax.random.key(0), density, 100_000)
    assert 100 < truth.effective < 100_000 and np.all((truth.sd > 0.1) & (truth.sd < 1.5))
    # Two such runs: their mean, and their difference.
    assert np.all(np.abs(truth.mean - mean) < 4 * truth.sd / np.sqrt(2 * truth.effective))
    assert np.all((truth.halves[0] - truth.halves[1]) ** 2 < 16 * 2 * truth.noise) and np.allclose(truth.noise, truth.sd**2 / truth.effective)


@pytest.mark.long
def test_the_truth_by_chains_is_the_same(target):
    density, mean = target
    truth = true_mean.true_mean_by_chains(jax.random.key(1), density, 400, chains=16, starts=2000)
    assert truth.by == "hmc" and truth.converged and truth.rhat < 1.01 and truth.effective > 1000
    assert np.all(np.abs(truth.mean - mean) < 4 * truth.sd / np.sqrt(2 * truth.effective))
    # The posterior is normal, so gradients take nearly all noise out.
    assert np.all(truth.noise < 0.1 * truth.sd**2 / truth.effective) and np.all(np.abs(truth.mean - mean) < 6 * np.sqrt(truth.noise) + 1e-5)


def test_the_better_truth_is_worth_more_draws():
    halves, nothing = np.zeros((2, 1)), np.zeros(1)
    particles, chains = true_mean.Truth(halves, nothing, nothing, 500.0), true_mean.Truth(halves, nothing, nothing, 5000.0, "hmc", 1.005)
    assert true_mean.better_of(particles, chains) is chains and chains.converged
    assert not chains._replace(rhat=1.05).converged and not chains._replace(rhat=float("nan")).converged
    other = true_mean.better_of(particles, chains._replace(effective=40.0, rhat=1.05))
    assert other.by == "sir" and other.effective == 500 and other.rhat == 1.05 and other.converged


def test_a_truth_that_is_too_rough_is_said():
    one = np.ones((5, 1))
    equal = ev.Equal(ev.Runs(one, 10, 0.1), {at: ev.Runs(one, 10, 0.1) for at in ("evaluations", "seconds")}, {"evaluations": 10, "seconds": 10}, 1.3)
    truths = (true_mean.Truth(np.zeros((2, 1)), one[0], np.array([noise]), 300.0) for noise in (0.05, 0.2))
    sound, doubtful = (ev.figures_of(["a"], equal, truth) for truth in truths)
    assert sound["settings"]["truth_noise"] == 0.05 and "meaningless" not in ev.summary(sound)
    assert "the variance of one of its two runs is at most 20.0% of hmc's error²" in ev.summary(doubtful)
    assert "a variance above 10% is too much: these ratios are meaningless; leave out --quick" in ev.summary(doubtful)


@pytest.mark.slow
def test_a_rough_truth_adds_nothing_to_an_error_on_average():
    """Its noise is as large as the error² of the better sampler. Deviations from its mean would count half of it."""
    rng, noise, variances = np.random.default_rng(5), np.full(1, 0.01), (0.1, 0.01)
    over, under = (ev.Runs(np.sqrt(variance) * rng.normal(size=(50, 1)), 10, 0.1) for variance in variances)
    truths = [true_mean.Truth(0.1 * rng.normal(size=(2, 1)), np.ones(1), noise, 100.0) for _ in range(400)]
    for runs in (over, under):
        exact = np.mean(runs.means**2)
        estimates = [truth.squared_errors(runs.means).mean() for truth in truths]
        assert abs(np.mean(estimates) - exact) < 4 * np.std(estimates) / np.sqrt(len(estimates))
        assert np.mean([np.mean((runs.means - truth.mean) ** 2) for truth in truths]) - exact == pytest.approx(noise[0] / 2, rel=0.3)
    # Intervals contain the ratio of exact errors at least as often as they say, if the noise is one that is allowed.
    exact, allowed = np.mean(over.means**2) / np.mean(under.means**2), true_mean.LARGEST_NOISE
    finer = [truth._replace(halves=np.sqrt(allowed) * truth.halves, noise=allowed * noise) for truth in truths[:40]]
    intervals = [ev.ratios(over, under, truth).per_dof[0, 1:] for truth in finer]
    assert sum(low < exact < high for low, high in intervals) >= 38


def test_the_error_of_n_draws_is_the_variance_over_n(target):
    density, mean = target
    truth = true_mean.Truth(np.tile(mean, (2, 1)), np.ones(3), np.zeros(3), 1e6)
    few, many = (ev.run_many(jax.random.key(n), density, _independent(jnp.asarray(mean), 1.0, n), 400) for n in (10, 160))
    found = ev.ratios(few, many, truth)
    assert few.evaluations == 10 and many.evaluations == 160 and few.seconds > 0
    # The standard error of a mean square of 400 runs is 7 %.
    assert np.allclose(found.per_dof[:, 0], 16, rtol=0.35)
    assert found.interval[0] < 16 < found.interval[1] and np.all(found.per_dof[:, 1] < 16) and np.all(found.per_dof[:, 2] > 16)


def test_a_bias_counts(target):
    density, mean = target
    truth = true_mean.Truth(np.tile(mean, (2, 1)), np.ones(3), np.zeros(3), 1e6)
    biased, honest = (ev.run_many(jax.random.key(n), density, _independent(jnp.asarray(mean) + off, 0.1, 50), 20) for n, off in ((1, 1.0), (2, 0.0)))
    assert ev.ratios(biased, honest, truth).median > 1000


@pytest.mark.slow
def test_both_samplers_find_the_same_posterior(target):
    density, mean = target
    hmc = ev.hmc_sampler(chains=8, burn_in=40, leapfrog_steps=8, step=0.6)
    for sampler in (lambda key, density: hmc(key, density, 800), true_mean.sir_sampler(20_001)):
        runs = ev.run_many(jax.random.key(3), density, sampler, 20)
        assert np.max(np.abs(runs.means.mean(axis=0) - mean) / (runs.means.std(axis=0, ddof=1) / np.sqrt(20))) < 4.5


def test_the_cost_of_a_gradient_is_the_ratio_of_the_shortest_times(target, monkeypatch):
    """By a clock that runs as it is asked: gradients take 6 s and more, values 2 s and more."""
    gradients, values = (least + np.arange(ev.TIMED) for least in (6.0, 2.0))
    ticks = np.cumsum([step for seconds in (*gradients[::-1], *values) for step in (0.0, seconds)])
    monkeypatch.setattr(ev, "time", SimpleNamespace(perf_counter=iter(ticks.tolist()).__next__))
    assert ev.gradient_cost(target[0]) == pytest.approx(3.0)


def test_errors_fall_with_computation_as_those_of_independent_draws(tmp_path):
    """Means of n draws have an error² of 1/n in units of the posterior's variance; their standard error is that of a chi-squared mean."""
    rng, runs, draws, sd, names = np.random.default_rng(3), 400, (10, 40), np.array([0.5, 1.0, 2.0, 1.0]), computation_curve.SHOWN
    truth = true_mean.Truth(np.tile([0.3, -1.0, 0.0, 2.0], (2, 1)), sd, np.zeros(4), 1e6)

    def means_of(count):
        return ev.Runs(truth.mean + sd * rng.normal(size=(runs, 4)) / np.sqrt(count), 2.0 * count, 1.0)

    equals = [ev.Equal(means_of(count), {"evaluations": means_of(count / 5)}, {"evaluations": 3 * count}, 1.5) for count in draws]
    curve = computation_curve.curve_of(equals, truth)
    assert curve.evaluations.tolist() == [30, 120] and curve.hmc.shape == curve.sir.shape == (2, 2, 4)
    for errors, counts in ((curve.hmc, np.array(draws)), (curve.sir, np.array(draws) / 5)):
        wanted = np.repeat(1 / counts[:, None], 4, axis=1)
        standard_error = wanted * np.sqrt(2 / runs)
        assert np.all(np.abs(errors[0] - wanted) < 5 * standard_error)
        np.testing.assert_allclose(errors[1], standard_error, rtol=0.4)
    computation_curve.draw_curve(tmp_path / "curve.png", names, curve)
    assert cv2.imread(str(tmp_path / "curve.png")).std() > 10
