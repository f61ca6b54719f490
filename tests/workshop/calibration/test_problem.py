"""Cases are draws of the model's own joint distribution, constraints included; what cannot be drawn exactly is refused."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from equal_computation import mixture_after
from scipy import stats
from workshop.calibration import toys

from bayes_body.base.errors import InputError
from bayes_body.density.factor import Factor
from bayes_body.model.body.placed_body import loosened
from bayes_body.model.build import build_model
from bayes_body.tracking.draws import Draws, Timing
from bayes_body.workshop.calibration.problem import MOST_PATHS, check_cases, draw_case, draw_path, point_mass, problem_of


def _always(level, values, data):
    return jnp.full((), level) + 0.0 * jnp.sum(values[toys.X])


def with_constraint(level):
    problem = toys.skewed()
    factor = Factor("all", "constraint", (toys.X,), toys.partial(_always, jnp.asarray(level, jnp.float32)))
    return dataclasses.replace(problem, factors=(*problem.factors, factor))


def draw(problem, count, frames=2):
    return jax.jit(lambda keys: jax.lax.map(lambda key: draw_case(key, problem, frames), keys))(jax.random.split(jax.random.key(0), count))


@jax.jit
def draw_constrained(keys, factors):
    """With the factors as argument: one program for constraints of all levels."""
    problem = dataclasses.replace(toys.skewed(), factors=factors)
    return jax.lax.map(lambda key: draw_case(key, problem, 2), keys)


def test_a_gaussian_case_has_the_law_of_the_model():
    problem = dataclasses.replace(toys.gaussian(), wandering=0)
    case = draw(problem, 4000)
    assert np.allclose(case.first["x"], problem.first["x"])
    last = np.asarray(case.path["x"][:, 1])
    cov = 2 * toys.ROOT @ toys.ROOT.T
    off = (last.mean(axis=0) - np.asarray(problem.first["x"])) / np.sqrt(np.diag(cov) / 4000)
    assert np.abs(off).max() < 4
    assert np.allclose(np.cov(last.T), cov, atol=0.04)
    residual = (np.asarray(case.data["seen"][:, 1]) - last @ toys.LOOK.T)[:, 0] / toys.NOISE
    assert stats.kstest(residual, "norm").pvalue > 1e-3


def test_a_path_is_accepted_as_a_whole():
    """Behind a soft wall in both frames: against weighted draws of the prior."""
    problem = dataclasses.replace(toys.skewed(wall=True), wandering=0)
    case = draw(problem, 3000)
    assert not case.refused.any() and not case.unbounded.any()
    found = np.asarray(case.path["x"][:, 0, 1], float)
    free = draw(dataclasses.replace(toys.skewed(), wandering=0, first=problem.first), 40_000)
    path = np.asarray(free.path["x"][:, :, 1], float)
    weights = np.exp(-0.5 * (np.maximum(path - 0.25, 0) / 0.15) ** 2).prod(axis=1)
    mean = weights @ path[:, 0] / weights.sum()
    assert abs(found.mean() - mean) < 4 * np.hypot(found.std() / np.sqrt(3000), found.std() / np.sqrt(20_000))
    assert abs(path[:, 0].mean() - mean) > 0.1


def test_a_path_starts_at_one_of_the_particles_by_weight():
    problem = toys.skewed()
    particles = point_mass(problem.first, 2)._replace(log_weights=jnp.log(jnp.array([0.2, 0.8])))
    starts = jax.jit(jax.vmap(lambda key: draw_path(key, problem, particles, 1).start))(jax.random.split(jax.random.key(1), 2000))
    assert abs(float(starts.mean()) - 0.8) < 4 * np.sqrt(0.16 / 2000)


def test_constraints_that_refuse_everything_are_said():
    case = draw_constrained(jax.random.split(jax.random.key(0), 2), with_constraint(-np.inf).factors)
    with pytest.raises(ValueError, match=f"{MOST_PATHS} paths of the motion prior were all rejected"):
        check_cases(case.refused, case.unbounded)


def test_a_constraint_above_zero_is_said():
    case = draw_constrained(jax.random.split(jax.random.key(0), 2), with_constraint(0.5).factors)
    with pytest.raises(ValueError, match="a constraint's log-potential is above 0"):
        check_cases(case.refused, case.unbounded)


def test_first_states_wander():
    case = draw(toys.gaussian(), 500)
    spread = np.asarray(case.first["x"]).std(axis=0)
    assert np.allclose(spread, np.sqrt(10 * np.diag(toys.ROOT @ toys.ROOT.T)), rtol=0.15)


def test_a_likelihood_that_is_no_distribution_is_refused():
    problem = toys.skewed()
    blind = dataclasses.replace(problem, factors=(dataclasses.replace(problem.factors[0], simulate=None),))
    with pytest.raises(ValueError, match="'y' is not a distribution over images"):
        draw_case(jax.random.key(0), blind, 1)


def test_what_needs_joint_angles_refuses_a_loose_limbed_body(textured_session):
    model = build_model("arm", textured_session)
    model = dataclasses.replace(model, body=loosened(model.body))
    with pytest.raises(InputError, match=r'calibration of joint angles: \[body\] placement = "parts"; expected placement = "angles"'):
        problem_of(model)
    with pytest.raises(InputError, match=r'comparison of mean joint angles: \[body\] placement = "parts"; expected placement = "angles"'):
        mixture_after(jax.random.key(0), Draws(model, (), Timing(0.0, 0.0), ("a",)), 2)
