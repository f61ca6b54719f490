"""Ranks of a truth among smoothed paths, in a frame that the filter left behind: an arm with markers, by all ways to lay paths; and mutants."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from bayes_body import kernels
from bayes_body.density.factor import Particles
from bayes_body.kernels.paths import rts
from bayes_body.kernels.paths.smoother import build_smoother
from bayes_body.model.build import build_model
from bayes_body.model.definition import load_definition, parse_definition
from bayes_body.tracking.backward import Backward, Filtered
from bayes_body.workshop.calibration import bands, looks
from bayes_body.workshop.calibration.problem import draw_case, point_mass, problem_of

pytestmark = pytest.mark.usefixtures("optimised")

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


@pytest.mark.long
@pytest.mark.parametrize("start", ["particles", "ensemble"])
def test_smoothed_paths_are_calibrated(textured_session, start):
    ranks = _replications(textured_session, start=start, moves=3)
    p = bands.p_values(bands.rank_counts(ranks, BINS))
    print(start, np.sort(p)[:4])
    # As many tests as there are quantities.
    assert p.min() > 0.01 / len(p)


# -- Gaussian paths: filter and smoother are one program, with the faults of mutants as arguments -------------------------------------------------

GAUSSIAN_FRAMES, DRAWS = 4, 256
# The first frame, whose filter knows least of what comes.
EARLY = 0
# Its gain has entries of different units, and is far from symmetric.
RANDOM_WALK = 'kind = "diffusion"\nat_fps = 60\n\n[dynamics.sd_deg]\n"shoulder_*" = 3.0\nelbow = 4.0\n'
WITH_VELOCITY = 'kind = "constant_velocity"\nat_fps = 60\n\n[dynamics.sd_deg]\n"*" = 0.5\n\n[dynamics.velocity_sd_deg]\n"*" = 30.0\n'


@pytest.fixture(scope="module")
def gaussian(textured_session, optimised):
    """`ranks(...)` (replication, quantity) of pose, markers and velocity in an early frame, and of the step to the next frame."""
    definition = load_definition("arm_markers")
    assert definition.text.count(RANDOM_WALK) == 1
    definition = parse_definition("arm", definition.text.replace(RANDOM_WALK, WITH_VELOCITY), definition.body_text)
    # A few steps from the middle of the joints' limits: beside a limit nothing would be normal.
    problem = problem_of(build_model(definition, textured_session), wandering=3)
    kernel, honest = kernels.laplace(fallback="none"), rts._given_next

    def figures(here, after):
        return jnp.concatenate([problem.quantities.compute(here), here["velocity"], after["pose"] - here["pose"]])

    @jax.jit
    def run(keys, transposed, explained, heed):
        def given_next(P, C, V):
            gain, rest = honest(P, C, V)
            return heed * jnp.where(transposed, gain.T, gain), P - explained * (P - rest)

        def one(key):
            truth_key, filter_key, path_key, chosen_key, tie_key = jax.random.split(key, 5)
            case = draw_case(truth_key, problem, GAUSSIAN_FRAMES)

            def forward(particles, frame):
                number, data = frame
                after, _ = kernel(jax.random.fold_in(filter_key, number), particles, problem.density(data, particles))
                after = Particles(dict(after.states), after.log_weights)
                return after, after

            def back(nexts, frame):
                number, particles = frame
                states = rts.states_before(jax.random.fold_in(path_key, number), particles, nexts, problem.transition)
                return states, states

            numbers = jnp.arange(GAUSSIAN_FRAMES)
            last, filtered = jax.lax.scan(forward, point_mass(case.first, DRAWS), (numbers, case.data))
            before = (numbers[:-1], jax.tree.map(lambda leaf: leaf[:-1], filtered))
            ends = rts.last_states(jax.random.fold_in(path_key, GAUSSIAN_FRAMES), last, DRAWS, problem.transition)
            _, paths = jax.lax.scan(back, ends, before, reverse=True)
            chosen = jax.random.choice(chosen_key, DRAWS, (BINS - 1,), replace=False)
            drawn = [jax.tree.map(lambda leaf, k=k: leaf[EARLY + k][chosen], paths) for k in range(2)]
            true = [jax.tree.map(lambda leaf, k=k: leaf[EARLY + k], case.path) for k in range(2)]
            # In one program, so that equal states have equal figures.
            everything = jax.vmap(figures)(
                *(jax.tree.map(lambda t, d: jnp.concatenate([t[None], d]), dict(t), dict(d)) for t, d in zip(true, drawn, strict=True))
            )
            truth, drawn = everything[0], everything[1:]
            ties = jnp.sum(drawn == truth, axis=0)
            return jnp.sum(drawn < truth, axis=0) + jax.random.randint(tie_key, ties.shape, 0, ties + 1)

        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(rts, "_given_next", given_next)
            return jax.lax.map(one, keys)

    def ranks(transposed=False, explained=1.0, heed=1.0):
        return np.asarray(run(jax.random.split(jax.random.key(6), 2 * REPLICATIONS), transposed, jnp.float32(explained), jnp.float32(heed)))

    return ranks


def _p_values(ranks):
    return bands.p_values(bands.rank_counts(ranks, BINS))


@pytest.mark.long
def test_gaussian_paths_are_calibrated(gaussian):
    p = _p_values(gaussian())
    print(np.sort(p)[:4])
    assert p.min() > 0.01 / len(p)


@pytest.mark.slow
@pytest.mark.parametrize(
    "fault", [{"transposed": True}, {"explained": 0.0}, {"heed": 0.0}], ids=["gain transposed", "noise of the filter", "next frame ignored"]
)
def test_faulty_gaussian_paths_are_found_out(gaussian, fault):
    p = _p_values(gaussian(**fault))
    print(fault, np.sort(p)[:4])
    # A check with this test alone would fail at its first look.
    assert p.min() <= looks.limits(0, 1, len(p)).fails
