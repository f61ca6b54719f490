"""A first call of each term of a user's plugins, before many replications in other processes: its faults are sentences that name its line."""

from dataclasses import replace
from typing import Any

import jax
import numpy as np

from bayes_body.base.errors import input_error
from bayes_body.density.density import Density
from bayes_body.density.factor import Particles
from bayes_body.density.kernel import Kernel
from bayes_body.model.body.placement import POSE
from bayes_body.model.build import Model
from bayes_body.model.plugins.load import check_own_factors
from bayes_body.model.plugins.terms import OwnKernel, check_result
from bayes_body.workshop.calibration.problem import draw_data, draw_path, point_mass, problem_of

# Particles of a first call: whatever their number, the same code runs.
FEW = 8


def probe(model: Model, kernel: Kernel, runs: bool = True) -> None:
    """Call each term that is not built in once.

    Without likelihoods that can be simulated there are no data: then only the prior's terms have values, and a kernel is traced on the prior.

    Args:
        model: the model with the terms.
        kernel: a kernel; one that is not built in is called.
        runs: whether it is also run on data, so that its numbers can be checked; else it is only traced.

    Raises:
        InputError: a term fails, or returns something else than it must.
    """
    particles = model.start(FEW)
    density = _simulated(model, particles) or _prior(model, particles)
    check_own_factors(density, model.initial)
    if not isinstance(kernel, OwnKernel):
        return
    key = jax.random.key(0)
    if runs and len(density.factors) == len(model.factors):
        next_particles, _ = jax.device_get(jax.jit(kernel)(key, particles, density))
        check_result(kernel, next_particles, 0)
    else:
        jax.eval_shape(kernel, key, particles, density)


def check_effective(where: str, figures: np.ndarray) -> None:
    """Check that what was computed from a kernel's weights are numbers, (repetition, figure).

    Raises:
        InputError: one is NaN, as after log-weights that are NaN.
    """
    if np.isnan(figures).any():
        problem = f"in {np.isnan(figures).any(axis=-1).mean():.0%} of the repetitions its log-weights are NaN"
        raise input_error(where, problem, "normalised log-weights", "where no particle explains the data, return equal ones and set `lost`")


def _prior(model: Model, particles: Particles) -> Density:
    return Density(model.transition, tuple(factor for factor in model.factors if factor.side != "likelihood"), {}, particles)


def _simulated(model: Model, particles: Particles) -> Density | None:
    """The density of a frame that is drawn from the model; None if it cannot be drawn."""
    likelihoods = [factor for factor in model.factors if factor.side == "likelihood"]
    if model.body.variable != POSE or any(factor.simulate is None for factor in likelihoods):
        return None
    problem = replace(problem_of(model), factors=tuple(likelihoods))

    def data(key: Any) -> Any:
        path = draw_path(key, problem, point_mass(problem.first), 1)
        return jax.tree.map(lambda leaf: leaf[0], draw_data(key, problem, path))

    return Density(model.transition, model.factors, jax.jit(data)(jax.random.key(0)), particles)
