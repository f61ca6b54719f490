"""The joint posterior of all frames of a filtered session as one Gaussian, and draws of paths from it (kernels/paths/joint.py).

The search starts from the means of each run of the filter. All data of the recording are in memory at once. The paths are stored as those of a
smoother are (tracking/smooth.py). They have equal weights. Pareto k of a frame says how well the Gaussian fits the exact density in a window of a few
frames about it.
"""

import time
from contextlib import closing
from dataclasses import replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from bayes_body.base.errors import input_error
from bayes_body.base.shapes import Key
from bayes_body.density.ahead import sampled_of
from bayes_body.density.density import Density
from bayes_body.density.factor import Particles, State, Transition
from bayes_body.density.frames import Frames as StackedFrames
from bayes_body.density.frames import stacked
from bayes_body.density.gaussian_view import joined, split
from bayes_body.density.kernel import NO_ANCESTOR, FilterInfo
from bayes_body.kernels.batching import everywhere
from bayes_body.kernels.laplace.pareto import pareto_shape
from bayes_body.kernels.paths.joint.path import FirstFrame, JointPath, log_ratios, solve_path, window_log_weights
from bayes_body.model.build import Model
from bayes_body.recording.session.session import Session
from bayes_body.tracking.draws import FrameResult, Frames
from bayes_body.tracking.observations import observations

# Draws of the first frame's prior. The error of a variance is then two percent.
PRIOR_DRAWS = 8192
# Added to the variances of this prior, relative and absolute, so that the covariance has an inverse in float32.
FLOOR = (1e-4, 1e-10)
# Number of frames on both sides of a frame whose terms are in its weights.
HALF_WIDTH = 1


class JointPaths(NamedTuple):
    """The paths of all runs, and what the search says of them.

    Attributes:
        frames: the frames in the order of time, as those of a smoother.
        solutions: the Gaussian of each run.
        pareto_k: the tail shape of the window's weights, for each run and frame; NaN if they are nearly equal.
        seconds: wall-clock seconds, compilation included.
    """

    frames: list[FrameResult]
    solutions: tuple[JointPath, ...]
    pareto_k: Float[np.ndarray, "run frame"]
    seconds: float


def solve(session: Session, model: Model, filtered: Frames, key: Key, draws: int = 250) -> JointPaths:
    """Draw paths from the Gaussian of each run of a filter.

    Args:
        session: the recording.
        model: the model with which the session was filtered.
        filtered: the frames of the filters.
        key: random key of all paths.
        draws: number of paths of each run.

    Raises:
        InputError: a frame cannot be read, a run started anew, or the model has no such Gaussian (`kernels.paths.joint.solve_path`).
    """
    restarted = [index for index, frame in enumerate(filtered) if frame.restarted.any()]
    if restarted:
        problem = f"the filter started anew in frame {session.frame_number(restarted[0])}"
        raise input_error("the joint posterior of all frames", problem, "runs that go on through all frames", "smooth by paths")
    started = time.perf_counter()
    start_key, prior_key, draw_key = jax.random.split(key, 3)
    start = everywhere(model.start(PRIOR_DRAWS, start_key))
    with closing(observations(session, model, range(len(filtered)))) as observed:
        densities = [Density(model.transition, model.factors if o.factors is None else o.factors, o.data, start) for o in observed]
    frames = stacked(densities)
    first, centre = _first_frame(prior_key, model.transition, start)
    unlimited = without_limits(model)
    runs = range(filtered[0].log_weights.shape[0])
    starts = [_means(model.transition, filtered, run, centre) for run in runs]
    solutions = [solve_path(frames, unlimited, first, start) for start in starts]
    drawn = [_drawn(jax.random.fold_in(draw_key, run), frames, solutions[run], starts[run], draws) for run in runs]
    states = {name: np.stack([values[name] for values, _ in drawn]) for name in drawn[0][0]}
    pareto_k = np.stack([shapes for _, shapes in drawn])
    seconds = time.perf_counter() - started
    results = [_result(frame, index, states, solutions, pareto_k, seconds / len(filtered)) for index, frame in enumerate(filtered)]
    return JointPaths(results, tuple(solutions), pareto_k, seconds)


def without_limits(model: Model) -> Transition:
    """Return a model's motion prior without joint limits: with infinite numbers in place of the body's limits."""
    skeleton = model.body.skeleton
    ends = [(np.asarray(skeleton.low), -np.inf), (np.asarray(skeleton.high), np.inf)]

    def freed(leaf: Any) -> Any:
        for limit, infinite in ends:
            if np.shape(leaf) == limit.shape and np.array_equal(leaf, limit):
                return jnp.full_like(leaf, infinite)
        return leaf

    return replace(model.transition, conditional=jax.tree.map(freed, model.transition.conditional))


def _first_frame(key: Key, transition: Transition, start: Particles) -> tuple[FirstFrame, State]:
    """Return the Gaussian prior of the first frame, and its mean as a state."""
    count = start.log_weights.shape[0]
    sampled = jax.jit(jax.vmap(lambda key, state: sampled_of(transition, transition.sample(key, state))))(
        jax.random.split(key, count), dict(start.states)
    )
    form = jax.tree.map(lambda leaf: leaf[0], sampled)
    rows = jax.vmap(lambda state: joined(transition.near(state, form)))(sampled)
    mean, covariance = jnp.mean(rows, axis=0), jnp.cov(rows.T)
    relative, absolute = FLOOR
    precision = jnp.linalg.inv(covariance + jnp.diag(relative * jnp.diagonal(covariance) + absolute))
    return FirstFrame(mean, precision), split(mean, form)


def _means(transition: Transition, filtered: Frames, run: int, centre: State) -> dict[str, Array]:
    """Return the weighted means of a run (frame, ...), each angle on the turn nearest to the frame before."""
    means = []
    for frame in filtered:
        weights = np.exp(frame.log_weights[run])
        values = {name: np.asarray(frame.states[name][run]) for name in centre}
        mean = {name: jnp.asarray(transition.space(name, v.shape[1:]).mean(weights / weights.sum(), v), v.dtype) for name, v in values.items()}
        centre = transition.near(mean, centre)
        means.append(centre)
    return {name: jnp.stack([mean[name] for mean in means]) for name in centre}


def _drawn(key: Key, frames: StackedFrames, solution: JointPath, start: State, count: int) -> tuple[dict[str, np.ndarray], np.ndarray]:
    """Return whole states of paths (path, frame, ...), and Pareto k of each frame."""
    paths = jax.jit(lambda solution, key: solution.draw(key, count))(solution, key)
    log_weights = window_log_weights(*log_ratios(frames, solution, paths, start), half_width=HALF_WIDTH)
    form = jax.tree.map(lambda leaf: leaf[0], dict(start))
    inside = solution.inside(paths)
    states = jax.jit(jax.vmap(jax.vmap(lambda row: frames.transition.with_derived(split(row, form)))))(inside)
    shapes = jax.jit(jax.vmap(pareto_shape, 1))(log_weights)
    return jax.device_get((states, shapes))


def _result(
    filtered: FrameResult,
    index: int,
    states: dict[str, np.ndarray],
    solutions: list[JointPath],
    pareto_k: Float[np.ndarray, "run frame"],
    seconds: float,
) -> FrameResult:
    runs, draws = next(iter(states.values())).shape[:2]
    dtype = filtered.log_weights.dtype
    ones, no_rate = np.ones((runs, 1), dtype), np.full((runs, 1), np.nan, dtype)
    steps = np.array([int(solution.steps) for solution in solutions])
    info: dict[str, Any] = {
        "ancestors": np.full((runs, draws), NO_ANCESTOR, np.int32),
        "ess": np.full(runs, draws, dtype),
        "survival_rate": ones,
        "inverse_temperatures": ones,
        "log_evidence": np.asarray(filtered.info.log_evidence),
        "lost": np.asarray(filtered.info.lost),
        "acceptance_rate": no_rate,
        "evaluations": (draws + steps).astype(np.int32),
        "modes": {"attempt": np.zeros(runs, np.int32), "steps": steps, "modes": np.ones(runs, dtype), "pareto_k": pareto_k[:, index]},
    }
    by_variable = {name: values[:, :, index] for name, values in states.items()}
    log_weights = np.full((runs, draws), -np.log(draws), dtype)
    return FrameResult(by_variable, log_weights, FilterInfo(**info), filtered.seen, seconds, 0.0, filtered.restarted)
