"""The hybrid Monte Carlo filter against closed forms and quadrature, from overdispersed starts; and mutants of its chains that these find out."""

from dataclasses import replace
from functools import cache, partial

import jax
import jax.numpy as jnp
import numpy as np
import numpyro.distributions as dist
import pytest
from blackjax.mcmc import hmc as blackjax_hmc
from blackjax.mcmc import metrics
from closed_forms.targets import conjugate, skewed

from bayes_body.base.errors import InputError
from bayes_body.density.coordinates import Coordinates
from bayes_body.density.density import Density
from bayes_body.density.factor import Factor, Particles, Transition, Variable
from bayes_body.density.spaces import SO3, circle
from bayes_body.kernels.hmc import hmc_filter
from bayes_body.kernels.hmc.hamiltonian import Schedule, chain_figures, effective_draws, run_chain
from bayes_body.kernels.hmc.hmc_filter import build_kernel
from bayes_body.kernels.hmc.mass import correlated, differenced, inverse_mass
from bayes_body.kernels.hmc.starts import compares_frames
from bayes_body.tracking.track import raise_if_all_rejected

CHAINS = 64
# The particles before are all equal, and so are their means: the same target, at a sixtieth of the cost.
OPTIONS = {"chains": CHAINS, "burn_in": 60, "leapfrog_steps": 8, "step": 0.5, "carry": "means"}
DRAWS = 60
SHORT = Schedule(draws=5, burn_in=7, thinning=3, leapfrog_steps=4, jitter=0.0, sampler="hmc", target_acceptance=0.0)


def _means(density, seed=0, **options):
    """Of each chain the mean and the mean square of its draws."""
    kernel = jax.jit(build_kernel(**(OPTIONS | options)))
    particles, info = kernel(jax.random.key(seed), density.previous, density)
    draws = np.asarray(particles.states["x"], float).reshape(CHAINS, -1, density.previous.states["x"].shape[1])
    return draws, info


def _off(by_chain, exact):
    """How many standard errors the mean over independent chains is from the exact value, at worst."""
    return np.max(np.abs(by_chain.mean(axis=0) - exact) / (by_chain.std(axis=0, ddof=1) / np.sqrt(len(by_chain))))


@cache
def _moments(posterior):
    """E[x] and E[x²] of the posterior by an independent kernel: importance sampling from the prior."""
    density = posterior(1).density
    before = density.ancestor(0)

    @jax.jit
    def moments(keys):
        states = jax.vmap(lambda key: density.transition.sample(key, before))(keys)
        weights = jax.nn.softmax(jax.vmap(lambda state: density.log_weight(state, before))(states))
        return weights @ states["x"], weights @ states["x"] ** 2

    return jax.device_get(moments(jax.random.split(jax.random.key(1), 400_000)))


@pytest.fixture(scope="module", params=[conjugate, skewed], ids=["conjugate", "skewed"])
def posterior(request):
    return request.param


@pytest.fixture(scope="module")
def target(posterior):
    return posterior(CHAINS * DRAWS)


VARIANTS = {
    "hmc": {},
    "nuts": {"sampler": "nuts"},
    "correlated": {"mass": "particles"},
    "matrix": {"mass": "curvature_matrix"},
    "tuned": {"target_acceptance": 0.8},
    "adapted": {"mass": "adapted", "target_acceptance": 0.7},
    "annealed": {"starts_by": "annealing", "starts": 200},
    "tempered": {"starts_by": "tempering", "starts": 200},
}


def _on_both(cases, first):
    """The first case on the skewed target, which finds more faults; slow: the others there; long: all on the conjugate one."""
    skew = [pytest.param(skewed, case, id=f"skewed-{name}", marks=() if name == first else pytest.mark.long) for name, case in cases.items()]
    plain = [pytest.param(conjugate, case, id=f"conjugate-{name}", marks=pytest.mark.long) for name, case in cases.items()]
    return skew + plain


# By one Gaussian, which this prediction is.
GAUSSIAN = pytest.param(conjugate, {"prediction": "gaussian", "carry": "draws"}, id="conjugate-gaussian", marks=pytest.mark.slow)


@pytest.mark.parametrize(("posterior", "options"), [*_on_both(VARIANTS, "hmc"), GAUSSIAN], indirect=["posterior"])
def test_means_and_spreads_are_those_of_the_posterior(posterior, target, options):
    draws, info = _means(target.density, **options)
    assert not info.lost and 0.3 < float(info.acceptance_rate[0]) <= 1
    first, second = _moments(posterior)
    assert np.allclose(first, target.mean, atol=0.01)
    assert _off(draws.mean(axis=1), target.mean) < 4
    assert _off((draws**2).mean(axis=1), second) < 4.5


X, BEFORE = Variable("x"), Variable("x", -1)
ANCESTORS, SHARES = np.array([[0.0, 0.5], [1.0, -0.3], [2.5, 0.4]]), np.array([0.5, 0.3, 0.2])
MOVED, MOVED_SD, WALK_SD = np.array([0.4, 0.2]), 0.3, 0.5


def _step(previous):
    return {"x": dist.Normal(previous["x"], WALK_SD).to_event(1)}


def _moved(values, moved):
    """How far it has moved, as an image of both frames would tell."""
    return jnp.sum(dist.Normal(values[X] - 0.6 * values[BEFORE], MOVED_SD).log_prob(moved))


def _of_two_frames(count):
    """A density whose likelihood reads the previous frame: three ancestors, each repeated."""
    number = np.repeat(np.arange(3), count // 3)
    previous = Particles({"x": jnp.asarray(ANCESTORS[number], jnp.float32)}, jnp.asarray(np.log(SHARES[number] / (count // 3)), jnp.float32))
    factors = (Factor("moved", "likelihood", (X, BEFORE), jax.tree_util.Partial(_moved)),)
    return Density(Transition("walk", jax.tree_util.Partial(_step), jax.tree_util.Partial(_unused)), factors, {"moved": jnp.asarray(MOVED)}, previous)


def _unused(state, scale):
    return {"x": dist.Normal(state["x"], scale).to_event(1)}


@pytest.mark.slow
@pytest.mark.parametrize("sampler", ["hmc", pytest.param("nuts", marks=pytest.mark.long)])
def test_a_likelihood_of_two_frames_has_its_ancestor_redrawn(sampler):
    """The posterior is a mixture of Gaussians, one of each ancestor, with known weights."""
    count = CHAINS * DRAWS
    density = _of_two_frames(count)
    assert compares_frames(density)
    draws, info = _means(density, sampler=sampler, carry="draws", step=0.8)
    precision = 1 / WALK_SD**2 + 1 / MOVED_SD**2
    means = (ANCESTORS / WALK_SD**2 + (MOVED + 0.6 * ANCESTORS) / MOVED_SD**2) / precision
    weights = SHARES * np.exp(-0.5 * np.sum((MOVED - 0.4 * ANCESTORS) ** 2, axis=1) / (WALK_SD**2 + MOVED_SD**2))
    weights /= weights.sum()
    assert _off(draws.mean(axis=1), weights @ means) < 4
    assert _off((draws**2).mean(axis=1), weights @ (means**2 + 1 / precision)) < 4.5
    of_chains = np.asarray(info.ancestors).reshape(CHAINS, -1) // (count // 3)
    found = np.stack([(of_chains == k).mean(axis=1) for k in range(3)], axis=1)
    assert _off(found, weights) < 4


@pytest.mark.long
def test_tuning_comes_near_the_asked_acceptance(target):
    _, untuned = _means(target.density, step=3.0, burn_in=0)
    _, tuned = _means(target.density, step=3.0, target_acceptance=0.7, burn_in=200)
    assert float(untuned.acceptance_rate[0]) < 0.3 and abs(float(tuned.acceptance_rate[0]) - 0.7) < 0.2


@pytest.mark.slow
@pytest.mark.parametrize(
    ("posterior", "starts_by"), _on_both({name: name for name in ("importance", "annealing", "tempering")}, "importance"), indirect=["posterior"]
)
def test_evidence_is_estimated_by_the_starts(target, starts_by):
    _, info = _means(target.density, starts=20_000, starts_by=starts_by, burn_in=0, leapfrog_steps=1)
    assert abs(float(info.log_evidence) - target.log_evidence) < 0.1


@pytest.mark.long
def test_overdispersed_starts_reach_the_same_posterior(target, monkeypatch):
    honest = hmc_filter._Filter._initialise

    def far(self, key, view, chains):
        found = honest(self, key, view, chains)
        position = found.starts.position["x"]
        moved = {"x": position + 1.5 * jax.random.normal(key, position.shape)}
        return found._replace(starts=found.starts._replace(position=moved))

    monkeypatch.setattr(hmc_filter._Filter, "_initialise", far)
    draws, _ = _means(target.density, burn_in=150)
    assert _off(draws.mean(axis=1), target.mean) < 4


_chain_means = jax.jit(hmc_filter._chain_means, static_argnums=1)


def test_the_next_frame_starts_from_the_chains_means():
    density = conjugate(CHAINS * 2).density
    states = {"x": jnp.arange(CHAINS * 2 * 3, dtype=jnp.float32).reshape(-1, 3)}
    means = _chain_means(density.previous._replace(states=states), 2, density.transition)
    assert np.allclose(means.states["x"][0], states["x"][:2].mean(axis=0)) and means.states["x"].shape == (CHAINS, 3)
    assert np.isclose(jax.nn.logsumexp(means.log_weights), 0, atol=1e-6)


def test_the_means_of_chains_are_those_of_their_spaces():
    """Angles on both sides of the half turn, with a full turn more, and rotations with either sign."""
    density = conjugate(4).density
    transition = replace(density.transition, spaces=(("x", circle(("yaw",))), ("q", SO3())))
    q = jnp.array([[0.8, 0.6, 0, 0], [-0.8, 0.6, 0, 0], [1, 0, 0, 0], [-1, 0, 0, 0]])
    states = {"x": jnp.radians(jnp.array([[179.0], [-179.0], [3.0], [365.0]])), "q": q}
    means = _chain_means(density.previous._replace(states=states), 2, transition).states
    assert np.allclose(np.cos(means["x"][:, 0]), np.cos(np.radians([180.0, 4.0])), atol=1e-6)
    # The first two are turned the same angle forwards and backwards, up to the sign; the others are the identity.
    assert np.allclose(np.abs(means["q"][:, 0]), 1, atol=1e-6)


def test_full_turns_between_draws_are_no_spread():
    transition = replace(conjugate(4).density.transition, spaces=(("x", circle(("yaw", "roll"))),))
    near = np.random.default_rng(0).normal(3.1, 0.2, size=(100, 2))
    turned = near + 2 * np.pi * np.random.default_rng(1).integers(-1, 2, size=(100, 2))
    turned = jnp.asarray(turned)
    found = jax.device_get(jax.jit(hmc_filter._on_one_turn)({"x": turned, "other": turned}, jnp.full(100, 0.01), transition))
    assert np.allclose(found["x"] - found["x"].mean(axis=0), near - near.mean(axis=0), atol=1e-5)
    assert (found["other"] == np.asarray(turned)).all()


@pytest.mark.long
def test_ancestors_are_draws_or_the_first_of_a_chain():
    density = conjugate(32).density
    spread = density.previous._replace(states={"x": density.previous.states["x"] + jnp.linspace(-1, 1, 32)[:, None]})
    found = {}
    for carry in ("draws", "means"):
        _, info = jax.jit(build_kernel(chains=4, burn_in=5, leapfrog_steps=3, carry=carry))(jax.random.key(0), spread, density)
        found[carry] = set(np.asarray(info.ancestors).tolist())
    assert found["means"] <= {0, 8, 16, 24} and found["draws"] <= set(range(32)) and not found["draws"] <= {0, 8, 16, 24}


def test_effective_draws_of_independent_and_of_stuck_chains():
    rng, effective = np.random.default_rng(0), jax.jit(effective_draws)
    independent = rng.normal(size=(4, 500, 2)).astype(np.float32)
    assert np.all(np.asarray(effective(independent)) > 1200)
    slow = np.cumsum(independent, axis=1)
    assert np.all(np.asarray(effective(slow)) < 100)
    assert np.array_equal(effective(np.ones((4, 500, 2), np.float32)), [1.0, 1.0])
    assert np.array_equal(effective(independent[:, :2]), [4.0, 4.0])


@pytest.mark.slow
def test_figures_of_each_chain_are_left_behind():
    kernel = jax.jit(build_kernel(chains=4, burn_in=5, leapfrog_steps=5, step=0.5))
    target = conjugate(40)
    _, info = kernel(jax.random.key(0), target.density.previous, target.density)
    found = jax.device_get(info.markov)
    assert int(found["length"]) == 10 and found["ess"].shape == (3,) and float(info.ess) == found["ess"].min()
    assert all(found[name].shape == (4,) for name in ("acceptance", "divergences", "energy_fraction", "step"))
    assert (
        np.isclose(found["acceptance"].mean(), info.acceptance_rate[0])
        and np.all(found["step"] == np.float32(0.5))
        and not found["divergences"].any()
    )
    raise_if_all_rejected(info, 0)


@jax.jit
def _short_chain(key):
    """A chain on two standard normal variables."""
    return run_chain(key, {"x": jnp.zeros(2)}, lambda p: -0.5 * jnp.sum(p["x"] ** 2), jnp.asarray(0.5), jnp.ones(2), SHORT)


def test_the_energy_fraction_is_that_of_independent_energies_and_of_a_slow_walk():
    rng = np.random.default_rng(0)
    independent, slow = rng.normal(size=(1, 4000)), np.cumsum(rng.normal(size=(1, 4000)), axis=1)
    ones, chain, figures = np.ones((1, 4000), np.float32), _short_chain(jax.random.key(0)), jax.jit(chain_figures)
    for energy, low, high in ((independent, 1.8, 2.2), (slow, 0.0, 0.05)):
        found = figures(chain._replace(energy=jnp.asarray(energy), acceptance=ones, divergent=ones < 0))
        assert low < float(found["energy_fraction"][0]) < high


@pytest.mark.slow
def test_chains_that_stand_still_stop_the_run_with_a_smaller_step():
    kernel = jax.jit(build_kernel(chains=2, burn_in=0, leapfrog_steps=5, step=40.0))
    target = conjugate(8)
    _, info = kernel(jax.random.key(0), target.density.previous, target.density)
    with pytest.raises(InputError, match=r"frame 7: no chain moves: at a step factor of 40 the acceptance is .*; try step=0\.2"):
        raise_if_all_rejected(info, 7)
    raise_if_all_rejected(info._replace(lost=jnp.asarray(True)), 7)
    with pytest.raises(InputError, match=r"try step=0\.05"):
        raise_if_all_rejected(info._replace(markov=dict(info.markov) | {"step": jnp.full(2, 0.5)}), 7)


# -- the mass matrix ----------------------------------------------------------------------------------------------------------------------


# With the density and the position as arguments.
_inverse_mass = jax.jit(lambda density, at, before, whole: inverse_mass(density.unconstrained(), at, before, whole), static_argnums=3)


def test_the_mass_of_a_gaussian_is_its_curvature():
    density = conjugate(1).density
    at, before = jnp.array([0.3, -0.2, 0.1]), density.ancestor(0)
    unknown, whole = (_inverse_mass(density, {"x": at}, before, whole) for whole in (False, True))
    variances = np.asarray(density.transition.conditional(before)["x"].variance)
    curvature = -np.asarray(jax.jit(jax.hessian(lambda x: density.log_likelihood({"x": x}, before)))(at))
    assert np.allclose(1 / np.asarray(unknown), 1 / variances + np.diagonal(curvature), rtol=1e-3)
    assert np.abs(curvature - np.diag(np.diagonal(curvature))).max() > 1
    assert np.allclose(np.linalg.inv(whole), np.diag(1 / variances) + curvature, rtol=1e-3, atol=1e-2)


def _square(values, _):
    return -2 * jnp.sum(values[Variable("x")] ** 2)


def _square_curvature(_, __):
    return {"x": 4 * jnp.eye(3)}


def test_what_likelihoods_offer_is_taken_and_the_others_are_differenced():
    density = conjugate(1).density
    offering = Factor("square", "likelihood", (Variable("x"),), jax.tree_util.Partial(_square), curvature=jax.tree_util.Partial(_square_curvature))
    before, at = density.ancestor(0), {"x": jnp.array([0.3, -0.2, 0.1])}
    alone = np.linalg.inv(_inverse_mass(density, at, before, True))
    both = np.linalg.inv(_inverse_mass(replace(density, factors=(*density.factors, offering)), at, before, True))
    assert np.allclose(both, alone + 4 * np.eye(3), rtol=1e-3, atol=1e-2)
    assert np.all(np.asarray(differenced(replace(density, factors=(offering,)), at, before, jnp.ones(3))) == 0)


def test_a_negative_curvature_does_not_count():
    density = skewed(1).density
    state = {"x": jnp.array([0.0, 0.9])}

    @jax.jit
    def program(density, state):
        before, target = density.ancestor(0), density.unconstrained()
        masses = [inverse_mass(target, target.unconstrain(state), before, whole) for whole in (False, True)]
        return differenced(density, state, before, jnp.array([0.01, 0.01])), *masses

    found, diagonal, whole = program(density, state)
    assert np.isfinite(found).all()
    assert np.all(np.asarray(diagonal) > 0)
    assert np.all(np.linalg.eigvalsh(whole) > 0)


def test_a_dense_mass_keeps_the_scales_and_takes_the_correlations():
    rng = np.random.default_rng(1)
    root = np.array([[1.0, 0.0], [0.9, 0.3]])
    particles = jnp.asarray(rng.normal(size=(4000, 2)) @ root.T)
    found = np.asarray(jax.jit(correlated)(jnp.array([4.0, 0.25]), particles, jnp.ones(4000)))
    assert np.allclose(np.diagonal(found), [4.0, 0.25])
    assert np.isclose(found[0, 1] / np.sqrt(4.0 * 0.25), 0.9 * np.corrcoef(np.asarray(particles).T)[0, 1], atol=1e-3)
    same = np.asarray(jax.jit(correlated)(jnp.array([4.0, 0.25]), jnp.ones((10, 2)), jnp.ones(10)))
    assert np.array_equal(same, np.diag([4.0, 0.25]))


# -- mutants ------------------------------------------------------------------------------------------------------------------------------


def _found_out(**options):
    """Whether chains on the skewed posterior are seen to be wrong."""
    target = skewed(CHAINS * DRAWS)
    draws, _ = _means(target.density, **options)
    _, second = _moments(skewed)
    return max(_off(draws.mean(axis=1), target.mean), _off((draws**2).mean(axis=1), second)) > 5


@pytest.mark.long
def test_momentum_that_is_not_refreshed_is_found_out(monkeypatch):
    honest = metrics.default_metric
    fixed = jax.random.key(5)
    monkeypatch.setattr(
        metrics, "default_metric", lambda mass: (m := honest(mass))._replace(sample_momentum=lambda _, position: m.sample_momentum(fixed, position))
    )
    assert _found_out(jitter=0.0)


@pytest.mark.slow
def test_a_missing_metropolis_test_is_found_out(monkeypatch):
    def always(key, delta, before, after):
        del key, before
        return after, (True, jnp.exp(jnp.minimum(delta, 0.0)), None)

    honest = blackjax_hmc.build_kernel
    proposal = partial(blackjax_hmc.hmc_proposal, sample_proposal=always)
    monkeypatch.setattr(blackjax_hmc, "build_kernel", lambda **options: honest(**options, build_proposal=proposal))
    # Steps near the limit of stability, or the errors would be too small to be seen.
    assert _found_out(step=1.4)


@pytest.mark.long
def test_a_missing_log_determinant_is_found_out(monkeypatch):
    monkeypatch.setattr(Coordinates, "log_determinant", lambda self, position: 0.0 * jnp.sum(position["x"]))
    assert _found_out()


@pytest.mark.long
def test_momenta_of_the_inverted_mass_are_found_out(monkeypatch):
    honest = metrics.default_metric
    monkeypatch.setattr(metrics, "default_metric", lambda mass: honest(mass)._replace(sample_momentum=honest(1 / mass).sample_momentum))
    assert _found_out()


# -- what cannot be -----------------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"chains": 4, "particles": 8, "target_acceptance": 0.7, "burn_in": 0}, "give a burn_in"),
        ({"chains": 4, "particles": 8, "step": 0.0}, "step"),
        ({"chains": 4, "particles": 8, "sampler": "gibbs"}, "sampler"),
        ({"chains": 4, "particles": 8, "prediction": "gaussian", "carry": "means"}, 'needs carry = "draws"'),
    ],
)
def test_options_that_cannot_be_are_said(options, words):
    with pytest.raises(InputError, match=words):
        build_kernel(**options)


def test_a_chain_keeps_every_so_many_states_behind_its_burn_in():
    chain = _short_chain(jax.random.key(0))
    assert chain.positions["x"].shape == (5, 2) and chain.acceptance.shape == (15,) and int(chain.gradients) == 1 + 22 * 4
    assert not np.any(chain.divergent) and np.isfinite(chain.energy).all()
