"""Ranks of a truth among paths with unknowns: Gaussian smoothing, the joint Gaussian of all frames, and NUTS on a window, which is exact."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from workshop.calibration.unknown_arm import DRIFTING, SHORT, STATIC, model_of, problem_with_unknowns, with_priors

from bayes_body import kernels
from bayes_body.density.factor import Particles
from bayes_body.density.frames import Frames
from bayes_body.density.gaussian_view import joined, split
from bayes_body.density.trajectory import trajectory
from bayes_body.kernels.paths import rts
from bayes_body.kernels.paths.joint.path import FirstFrame, solve_path
from bayes_body.kernels.paths.joint.terms import base_of
from bayes_body.kernels.paths.window import sample_window
from bayes_body.tracking.joint import without_limits
from bayes_body.workshop.calibration import bands
from bayes_body.workshop.calibration.problem import draw_case

pytestmark = pytest.mark.usefixtures("optimised")

BINS, FRAMES, DRAWS, SEED = 20, 5, 512, 300
# Of NUTS fewer draws are nearly independent.
NUTS_BINS, REPLICATIONS, SCHEDULE = 10, 100, {"chains": 2, "warm_up": 150, "draws": 200}
# The first frame, whose filter knows least of what comes, and the last.
RANKED = (0, FRAMES - 1)
LENGTHS = [pytest.param(DRIFTING, id="drifting"), pytest.param(STATIC, id="static")]


class Arm:
    """The arm, and its programs: each is compiled once for all priors and faults."""

    def __init__(self, session):
        self.problem, self.unlimited = problem_with_unknowns(session), without_limits(model_of(session))
        self.kernel = kernels.laplace(fallback="none")
        self.prepare, self.rank = jax.jit(self._prepare), jax.jit(self._rank)
        self.paths = jax.jit(self._joint_paths, static_argnames="count")

    def true(self, retention):
        return with_priors(self.problem, retention, SHORT)

    def _prepare(self, key, retention):
        """A case, the particles before its first frame, and Gaussian smoothed paths (path, frame, ...)."""
        true = self.true(retention)
        truth_key, start_key, filter_key, path_key = jax.random.split(key, 4)
        case, numbers = draw_case(truth_key, true, FRAMES), jnp.arange(FRAMES)

        def forward(particles, frame):
            number, data = frame
            after, _ = self.kernel(jax.random.fold_in(filter_key, number), particles, true.density(data, particles))
            after = Particles(dict(after.states), after.log_weights)
            return after, after

        def back(nexts, frame):
            number, particles = frame
            states = rts.states_before(jax.random.fold_in(path_key, number), particles, nexts, true.transition)
            return states, states

        start = true.start(start_key, case.first, DRAWS)
        last, filtered = jax.lax.scan(forward, start, (numbers, case.data))
        before = (numbers[:-1], jax.tree.map(lambda leaf: leaf[:-1], filtered))
        ends = rts.last_states(jax.random.fold_in(path_key, FRAMES), last, DRAWS, true.transition)
        _, earlier = jax.lax.scan(back, ends, before, reverse=True)
        paths = jax.tree.map(lambda leaf, end: jnp.concatenate([jnp.moveaxis(leaf, 0, 1), end[:, None]], axis=1), earlier, ends)
        return case, start, paths

    def _rank(self, key, path, draws):
        """Ranks of pose, markers, unknowns and velocity in the ranked frames among draws (draw, frame, ...)."""

        def figures(state):
            return jnp.append(self.problem.quantities.compute(state), state["velocity"])

        # In one program, so that equal states have equal figures.
        states = jax.tree.map(lambda true, drawn: jnp.concatenate([true[None], drawn])[:, RANKED], dict(path), dict(draws))
        values = jax.vmap(jax.vmap(figures))(states)
        values = values.reshape(len(values), -1)
        ties = jnp.sum(values[1:] == values[0], axis=0)
        return jnp.sum(values[1:] < values[0], axis=0) + jax.random.randint(key, ties.shape, 0, ties + 1)

    def _joint_paths(self, key, solution, path, count):
        form = jax.tree.map(lambda leaf: leaf[0], path)
        draws = solution.inside(solution.draw(key, 2 * count)[::2])
        return jax.vmap(jax.vmap(lambda row: self.problem.transition.with_derived(split(row, form))))(draws)

    def joint(self, key, retention, case, start, paths):
        """Draws of the joint Gaussian, which knows the first frame's prior exactly."""
        true, unlimited = self.true(retention), with_priors(self.unlimited, retention, SHORT)
        first = {name: base_of(distribution) for name, distribution in unlimited.conditional(case.first).items()}
        first |= {term.name: base_of(term.prior()) for term in true.unknowns}
        mean, sd = ({name: getattr(distribution, part) for name, distribution in first.items()} for part in ("loc", "scale"))
        sd = {name: jnp.broadcast_to(sd[name], mean[name].shape) for name in mean}
        path = {name: jnp.mean(paths[name], axis=0) for name in mean}
        frames = Frames(true.transition, true.factors, case.data, False)
        solution = solve_path(frames, unlimited, FirstFrame(joined(mean), jnp.diag(joined(sd) ** -2)), path)
        assert solution.converged
        return self.paths(key, solution, path, BINS - 1)

    def nuts(self, key, retention, case, start, paths):
        """Draws of NUTS, nearly independent, and its figures. The prior of the first frame is one Gaussian, which is exact here."""
        prior_key, run_key = jax.random.split(key)
        true = self.true(retention)
        first = jax.tree.map(lambda leaf: leaf[0], paths)
        target = trajectory(Frames(true.transition, true.factors, case.data, False), start, first, gaussian=prior_key)
        window = sample_window(run_key, target, paths, **SCHEDULE)
        pooled = jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[2:]), window.states)
        chosen = np.linspace(0, len(pooled["pose"]) - 1, NUTS_BINS - 1).astype(int)
        return jax.tree.map(lambda leaf: leaf[chosen], pooled), window


@pytest.fixture(scope="module")
def arm(keypoint_session, optimised):
    return Arm(keypoint_session)


def _ranks(arm, replications, retention, draw):
    """Ranks (replication, quantity) of the truth among what `draw(key, case, start, paths)` returns."""
    ranks = []
    for seed in range(replications):
        case_key, draw_key, tie_key = jax.random.split(jax.random.fold_in(jax.random.key(SEED), seed), 3)
        case, start, paths = arm.prepare(case_key, jnp.float32(retention))
        ranks.append(np.asarray(arm.rank(tie_key, case.path, draw(draw_key, case, start, paths))))
    return np.array(ranks)


def _p_values(ranks, bins=BINS):
    return bands.p_values(bands.rank_counts(ranks, bins))


# -- Gaussian paths ---------------------------------------------------------------------------------------------------------------------------


@pytest.mark.long
@pytest.mark.parametrize("retention", LENGTHS)
def test_gaussian_smoothing_is_calibrated_for_unknowns(arm, retention):
    def thinned(key, case, start, paths):
        chosen = jax.random.choice(key, DRAWS, (BINS - 1,), replace=False)
        return jax.tree.map(lambda leaf: leaf[chosen], paths)

    p = _p_values(_ranks(arm, 400, retention, thinned))
    print(np.sort(p)[:4])
    assert p.min() > 0.01 / len(p)


@pytest.mark.parametrize(
    ("retention", "replications"),
    [
        pytest.param(DRIFTING, 400, id="drifting", marks=pytest.mark.long),
        pytest.param(STATIC, 200, id="static", marks=pytest.mark.long),
        pytest.param(STATIC, 400, id="static, more", marks=pytest.mark.long),
    ],
)
def test_the_joint_gaussian_is_calibrated_for_unknowns(arm, retention, replications):
    p = _p_values(_ranks(arm, replications, retention, lambda key, *drawn: arm.joint(key, retention, *drawn)))
    print(np.sort(p)[:4])
    assert p.min() > 0.01 / len(p)


# -- NUTS -------------------------------------------------------------------------------------------------------------------------------------


def _by_nuts(arm, replications, retention):
    """Ranks of NUTS, and what the chains say of themselves: (replication, ...) of R-hat, effective draws, divergences and leapfrog steps."""
    figures = []

    def draw(key, case, start, paths):
        draws, window = arm.nuts(key, retention, case, start, paths)
        steps = window.leapfrog_steps.mean()
        figures.append([float(v) for v in (window.r_hat.max(), window.effective.min(), window.divergent.sum(), steps)])
        return draws

    return _ranks(arm, replications, retention, draw), np.array(figures)


@pytest.mark.long
@pytest.mark.parametrize("retention", LENGTHS)
def test_nuts_on_a_window_is_calibrated_for_unknowns(arm, retention):
    ranks, figures = _by_nuts(arm, REPLICATIONS, retention)
    p = _p_values(ranks, NUTS_BINS)
    print(np.sort(p)[:4], np.quantile(figures, [0.05, 0.5, 0.95], axis=0))
    assert not figures[:, 2].any()
    assert p.min() > 0.01 / len(p)
