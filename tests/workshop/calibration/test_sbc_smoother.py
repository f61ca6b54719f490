"""Ranks of a truth among smoothed paths, in a frame that the filter left behind: an arm with markers, by both ways to lay paths."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from bayes_body import kernels
from bayes_body.density.factor import Particles
from bayes_body.kernels.paths.smoother import build_smoother
from bayes_body.model.build import build_model
from bayes_body.tracking.backward import Backward, Filtered
from bayes_body.workshop.calibration import bands
from bayes_body.workshop.calibration.problem import draw_case, point_mass, problem_of

pytestmark = [pytest.mark.long, pytest.mark.usefixtures("optimised")]

REPLICATIONS, BINS, FRAMES, RANKED, PARTICLES = 200, 20, 5, 2, 4000


def _replications(session, **options):
    """Ranks (replication, quantity) of the state in frame RANKED, and of the step to the next frame."""
    problem, kernel = problem_of(build_model("arm_markers", session)), kernels.sir()
    case = jax.jit(lambda key: draw_case(key, problem, FRAMES))
    step = jax.jit(lambda key, particles, data: kernel(key, particles, problem.density(data, particles)))
    figures = jax.jit(jax.vmap(lambda here, after: jnp.concatenate([problem.quantities.compute(here), after["pose"] - here["pose"]])))
    frames, data = [], []
    walk = Backward(
        build_smoother(draws=BINS - 1, **options), problem.transition, lambda t: frames[t], lambda t, before: problem.density(data[t], before)
    )

    def one(seed):
        truth_key, filter_key, path_key, tie_key = jax.random.split(jax.random.key(seed), 4)
        drawn = case(truth_key)
        particles = point_mass(drawn.first, PARTICLES)
        frames.clear()
        data[:] = [jax.tree.map(lambda leaf, t=t: leaf[t], drawn.data) for t in range(FRAMES)]
        for t in range(FRAMES):
            after, info = step(jax.random.fold_in(filter_key, t), particles, data[t])
            particles = Particles(dict(after.states), after.log_weights)
            frames.append(Filtered(particles, info.ancestors, t == 0))
        paths = {each.frame: each.states for each in walk.follow(path_key, FRAMES)}
        true = jax.tree.map(lambda leaf: leaf[RANKED : RANKED + 2], drawn.path)
        truth = figures(*(jax.tree.map(lambda leaf, k=k: leaf[k : k + 1], true) for k in range(2)))[0]
        found = figures(paths[RANKED], paths[RANKED + 1])
        ties = jnp.sum(found == truth, axis=0)
        return np.asarray(jnp.sum(found < truth, axis=0) + jax.random.randint(tie_key, ties.shape, 0, ties + 1))

    return np.array([one(seed) for seed in range(REPLICATIONS)])


@pytest.mark.parametrize("start", ["particles", "ensemble"])
def test_smoothed_paths_are_calibrated(textured_session, start):
    ranks = _replications(textured_session, start=start, moves=3)
    p = bands.p_values(bands.rank_counts(ranks, BINS))
    print(start, np.sort(p)[:4])
    # As many tests as there are quantities.
    assert p.min() > 0.01 / len(p)
