"""Smoothed paths, and NUTS on a window, against particle Gibbs: an arm of four dofs whose markers two cameras see, ten frames."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from closed_forms.conditional_smc import particle_gibbs

from bayes_body import kernels
from bayes_body.density.factor import Particles
from bayes_body.density.frames import stacked
from bayes_body.density.trajectory import trajectory
from bayes_body.kernels.paths.smoother import build_smoother
from bayes_body.kernels.paths.window import sample_window
from bayes_body.model.build import build_model
from bayes_body.tracking.backward import Backward, Filtered
from bayes_body.workshop.calibration.problem import draw_case, point_mass, problem_of

# These programs run for longer than they compile.
pytestmark = [pytest.mark.long, pytest.mark.usefixtures("optimised")]

FRAMES, PARTICLES, RUNS, DRAWS = 10, 4000, 8, 1000
CHAINS, SWEEPS, BURN_IN, REFERENCE = 8, 2000, 100, 60


@pytest.fixture(scope="module")
def arm(textured_session):
    """The problem, a truth with its data, and the frames."""
    problem = problem_of(build_model("arm_markers", textured_session))
    case = jax.jit(lambda key: draw_case(key, problem, FRAMES))(jax.random.key(3))
    data = [jax.tree.map(lambda leaf, t=t: leaf[t], case.data) for t in range(FRAMES)]
    frames = stacked([problem.density(each, point_mass(case.first)) for each in data])
    return problem, case, data, frames


@pytest.fixture(scope="module")
def reference(arm):
    """Poses (chain, sweep, frame, dof) of particle Gibbs."""
    _, case, _, frames = arm
    path = {"pose": case.path["pose"]}
    before = point_mass(case.first)
    keys = jax.random.split(jax.random.key(4), CHAINS)
    found = jax.jit(jax.vmap(lambda key: particle_gibbs(key, path, frames, before, REFERENCE, SWEEPS).states["pose"]))(keys)
    return np.asarray(found, float)[:, BURN_IN:]


def _smoothed(arm, **options):
    """Poses (run, path, frame, dof) of the smoother; each run has a filter of its own."""
    problem, case, data, _ = arm
    kernel, found, frames = kernels.sir(), [], []
    step = jax.jit(lambda key, particles, data: kernel(key, particles, problem.density(data, particles)))
    walk = Backward(
        build_smoother(draws=DRAWS, **options), problem.transition, lambda t: frames[t], lambda t, before: problem.density(data[t], before)
    )
    for run in range(RUNS):
        particles, key = point_mass(case.first, PARTICLES), jax.random.key(run)
        frames.clear()
        for t in range(FRAMES):
            after, info = step(jax.random.fold_in(key, t), particles, data[t])
            particles = Particles(dict(after.states), after.log_weights)
            frames.append(Filtered(particles, info.ancestors, t == 0))
        paths = {each.frame: np.asarray(each.states["pose"], float) for each in walk.follow(jax.random.fold_in(key, FRAMES), FRAMES)}
        found.append(np.stack([paths[t] for t in range(FRAMES)], axis=1))
    return np.array(found)


def _compare(name, one, other):
    """Print and return the largest distance of the means, in standard errors and in sds, and the range of the ratios of the sds."""
    means, sds = [each.mean(axis=1) for each in (one, other)], [each.reshape(-1, *each.shape[2:]).std(axis=0) for each in (one, other)]
    errors = [each.std(axis=0, ddof=1) / np.sqrt(len(each)) for each in means]
    error = np.sqrt(sum(np.maximum(each, np.median(each)) ** 2 for each in errors))
    difference = np.abs(means[0].mean(axis=0) - means[1].mean(axis=0))
    ratio = sds[0] / sds[1]
    figures = (difference / error).max(), (difference / sds[1]).max(), ratio.min(), ratio.max()
    print(f"{name}: means {figures[0]:.1f} standard errors, {figures[1]:.3f} sd apart; ratios of sds {figures[2]:.2f} to {figures[3]:.2f}")
    return figures


@pytest.mark.parametrize(
    "options",
    [{"start": "particles", "moves": 0}, {"start": "particles", "moves": 3}, {"start": "ensemble", "moves": 0}, {"start": "ensemble", "moves": 3}],
    ids=lambda options: f"{options['start']}, {options['moves']} moves",
)
def test_the_smoother_agrees_with_particle_gibbs(arm, reference, options):
    errors, _, low, high = _compare(str(options), _smoothed(arm, **options), reference)
    assert errors < 4.5 and 0.9 < low <= high < 1.1


def test_nuts_on_ten_frames_agrees_with_both(arm, reference):
    _, case, _, frames = arm
    smoothed = _smoothed(arm, start="particles", moves=3)
    paths = {"pose": jnp.asarray(smoothed.reshape(-1, FRAMES, smoothed.shape[-1]), float)}
    target = trajectory(frames, point_mass(case.first), jax.tree.map(lambda leaf: leaf[0], paths))
    found = sample_window(jax.random.key(5), target, paths, draws=2000, warm_up=500)
    print(f"R-hat {found.r_hat.max():.4f}, effective {found.effective.min():.0f}, steps {found.leapfrog_steps.mean():.1f}")
    assert found.r_hat.max() <= 1.01 and not found.divergent.any()
    poses = np.asarray(found.states["pose"], float)
    for name, other in (("particle Gibbs", reference), ("smoother", smoothed)):
        errors, sds, low, high = _compare(name, poses, other)
        assert sds < 0.1 and errors < 4.5 and 0.9 < low <= high < 1.1
