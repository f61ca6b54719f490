"""The joint posterior of all frames of a filtered session as one Gaussian, and draws of paths from it (kernels/paths/joint/path.py).

The search starts from the means of each run of the filter. All data of the recording are in memory at once. The paths are stored as those of a
smoother are (tracking/smooth.py). They have equal weights. Pareto k of a frame says how well the Gaussian fits the exact density in a window of a few
frames about it.
"""

import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from bayes_body.base.errors import input_error
from bayes_body.base.pareto import FEWEST_TAIL, tail_size
from bayes_body.base.shapes import Key
from bayes_body.density.ahead import sampled_of
from bayes_body.density.density import Density
from bayes_body.density.factor import Particles, State, Transition
from bayes_body.density.frames import Frames as StackedFrames
from bayes_body.density.frames import stacked
from bayes_body.density.gaussian_view import joined, split
from bayes_body.density.kernel import NO_ANCESTOR, FilterInfo
from bayes_body.kernels.batching import everywhere, on_first_device
from bayes_body.kernels.laplace.pareto import pareto_shape
from bayes_body.kernels.paths.joint.path import FirstFrame, JointPath, check_path, log_ratios, solve_path, window_log_weights
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
# A dof whose mean is nearer to a limit than this many standard deviations counts as near it. Beside a limit the Gaussian lies too far from it: of the
# beam's clavicles, which lean on their limits in all frames, two standard deviations would find one frame in twenty.
NEAR_LIMIT = 3.0


class JointPaths(NamedTuple):
    """The paths of all runs, and what the search says of them.

    Attributes:
        frames: the frames in the order of time, as those of a smoother.
        solutions: the Gaussian of each run.
        pareto_k: the tail shape of the window's weights, for each run and frame; -∞ if they are nearly equal, NaN with too few draws.
        seconds: wall-clock seconds, compilation included.
    """

    frames: Frames
    solutions: tuple[JointPath, ...]
    pareto_k: Float[np.ndarray, "run frame"]
    seconds: float


class _Paths(NamedTuple):
    """What is computed of one run: whole states (path, frame, ...), and what `FilterInfo.joint` has of each frame, (frame, ...)."""

    states: dict[str, np.ndarray]
    figures: dict[str, np.ndarray]


def solve(
    session: Session, model: Model, filtered: Frames, key: Key, draws: int = 250, on_progress: Callable[[str], None] = lambda doing: None
) -> JointPaths:
    """Draw paths from the Gaussian of each run of a filter.

    Args:
        session: the recording.
        model: the model with which the session was filtered.
        filtered: the frames of the filters.
        key: random key of all paths.
        draws: number of paths of each run.
        on_progress: receives words about what is being done; each step of the search has its own.

    Raises:
        InputError: a frame cannot be read, a run started anew, or the model has no such Gaussian (`kernels.paths.joint.path.check_path`).
    """
    started = time.perf_counter()
    check_model(model)
    on_progress(f"reading {len(filtered)} frames")
    refuse_restarts([session.frame_number(index) for index, frame in enumerate(filtered) if frame.restarted.any()])
    start_key, prior_key, draw_key = jax.random.split(key, 3)
    began = time.perf_counter()
    start = everywhere(model.start(PRIOR_DRAWS, start_key))
    first, centre = _first_frame(prior_key, model.transition, start)
    # What waits for the compiler: the first frame's prior, and the programs of the first run.
    ready = time.perf_counter() - began
    starts = _means(model.transition, filtered, centre)
    with closing(observations(session, model, range(len(filtered)))) as observed:
        densities = [Density(model.transition, model.factors if o.factors is None else o.factors, o.data, start) for o in observed]
    frames, unlimited = on_first_device(stacked(densities)), without_limits(model)
    starts = on_first_device(starts)
    del densities
    solutions, paths = list[JointPath](), list[_Paths]()
    for run, run_start in enumerate(starts):
        watch = _Watch(on_progress, run, len(starts))
        solutions.append(jax.block_until_ready(solve_path(frames, unlimited, first, run_start, on_step=watch)))
        waited = watch.waited()
        on_progress(f"run {run + 1} of {len(starts)}: drawing {draws} paths")
        drawn, compiled = _drawn(on_first_device(jax.random.fold_in(draw_key, run)), frames, solutions[run], run_start, draws, model.body.variable)
        paths.append(drawn)
        ready += 0.0 if run else waited + compiled
    seconds = time.perf_counter() - started
    results = _PathFrames(filtered, paths, draws, seconds - ready, ready)
    return JointPaths(results, tuple(solutions), np.stack([run_paths.figures["pareto_k"] for run_paths in paths]), seconds)


class _Watch:
    """What the steps of one run's search say, and the seconds of its first step and of what follows its last."""

    def __init__(self, on_progress: Callable[[str], None], run: int, runs: int):
        self._say = lambda doing: on_progress(f"run {run + 1} of {runs}: {doing}")
        self._begun, self._first = time.perf_counter(), 0.0
        self._say("compiling" if run == 0 else "Newton's first step")

    def __call__(self, steps: int, promise: float) -> None:
        self._last = time.perf_counter()
        self._first = self._first or self._last - self._begun
        self._say(f"{steps} Newton step{'s' * (steps != 1)} done, the next one promises {promise:.3g} nats")

    def waited(self) -> float:
        """Return the seconds in which programs were compiled, each with its first call."""
        return self._first + time.perf_counter() - self._last


def check_model(model: Model) -> None:
    """Check that the paths of a model have a Gaussian approximation.

    Raises:
        InputError: they have none (`kernels.paths.joint.path.check_path`).
    """
    form = sampled_of(model.transition, dict(model.initial))
    check_path(model.transition, model.factors, without_limits(model), form)


def refuse_restarts(frames: Sequence[int]) -> None:
    """Refuse runs that started anew.

    Args:
        frames: the numbers of the frames in which they did.

    Raises:
        InputError: there is such a frame.
    """
    if frames:
        problem = f"the filter started anew in frame {frames[0]}"
        raise input_error(
            "the joint posterior of all frames", problem, "runs that go on through all frames", "smooth by paths, such as --start ensemble"
        )


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


def _means(transition: Transition, filtered: Frames, centre: State) -> list[dict[str, Array]]:
    """Return the weighted means of each run (frame, ...), each angle on the turn nearest to the frame before."""
    runs = filtered[0].log_weights.shape[0]
    centres, means = [centre] * runs, [[] for _ in range(runs)]
    for frame in filtered:
        for run in range(runs):
            weights = np.exp(frame.log_weights[run])
            values = {name: np.asarray(frame.states[name][run]) for name in centre}
            mean = {name: transition.space(name, v.shape[1:]).mean(weights / weights.sum(), v) for name, v in values.items()}
            centres[run] = transition.near({name: jnp.asarray(v, values[name].dtype) for name, v in mean.items()}, centres[run])
            means[run].append(centres[run])
    return [{name: jnp.stack([mean[name] for mean in of_run]) for name in centre} for of_run in means]


def _drawn(key: Key, frames: StackedFrames, solution: JointPath, start: State, count: int, variable: str) -> tuple[_Paths, float]:
    """Return the paths of a run, and the seconds in which their program was compiled; `variable` is the one whose limits count."""
    began = time.perf_counter()
    program = _draw.lower(key, frames, solution, start, count).compile()
    compiled = time.perf_counter() - began
    states, shapes, distances = jax.device_get(program(key, frames, solution, start))
    # Without a fit of the tail the weights are nearly equal, unless there are too few of them.
    shapes = np.where(np.isnan(shapes) & (tail_size(count) >= FEWEST_TAIL), -np.inf, shapes)
    steps, converged = (np.full(len(shapes), value) for value in (np.int32(solution.steps), solution.converged))
    figures = {"steps": steps, "converged": converged, "pareto_k": shapes}
    return _Paths(states, figures | ({"near_limit": distances[variable] < NEAR_LIMIT} if variable in distances else {})), compiled


@partial(jax.jit, static_argnames="count")
def _draw(key: Key, frames: StackedFrames, solution: JointPath, start: State, count: int) -> tuple[dict[str, Array], Array, dict[str, Array]]:
    """Return whole states of paths (path, frame, ...), Pareto k of each frame, and the distances of the mean from the nearer limit in sd."""
    form = jax.tree.map(lambda leaf: leaf[0], dict(start))
    paths = solution.draw(key, count)
    log_weights = window_log_weights(*log_ratios(frames, solution, paths, start), half_width=HALF_WIDTH)
    states = jax.vmap(jax.vmap(lambda row: frames.transition.with_derived(split(row, form))))(solution.inside(paths))
    sd = jnp.sqrt(jnp.diagonal(solution.covariances(), axis1=1, axis2=2))
    distances = jnp.minimum(solution.mean - solution.low, solution.high - solution.mean) / sd
    return states, jax.vmap(pareto_shape, 1)(log_weights), jax.vmap(lambda row: split(row, form))(distances)


class _PathFrames:
    """The frames of all runs in the order of time. Each is made when it is asked for, so that the paths are in memory once."""

    def __init__(self, filtered: Frames, paths: list[_Paths], draws: int, seconds: float, ready: float):
        self._filtered, self._paths, self._draws, self._seconds, self._ready = filtered, paths, draws, seconds, ready

    def __len__(self) -> int:
        return len(self._filtered)

    def __iter__(self) -> Iterator[FrameResult]:
        return (self[index] for index in range(len(self)))

    def __getitem__(self, index: int, /) -> FrameResult:
        if not -len(self) <= index < len(self):
            raise IndexError(index)
        index %= len(self)
        frame, runs = self._filtered[index], len(self._paths)
        dtype = frame.log_weights.dtype
        ones = np.ones((runs, 1), dtype)
        info: dict[str, Any] = {
            "ancestors": np.full((runs, self._draws), NO_ANCESTOR, np.int32),
            "ess": np.full(runs, self._draws, dtype),
            "survival_rate": ones,
            "inverse_temperatures": ones,
            "log_evidence": np.asarray(frame.info.log_evidence),
            "lost": np.asarray(frame.info.lost),
            "acceptance_rate": np.full((runs, 1), np.nan, dtype),
            "evaluations": np.array([self._draws + paths.figures["steps"][index] for paths in self._paths], np.int32),
            "joint": {name: np.stack([paths.figures[name][index] for paths in self._paths]) for name in self._paths[0].figures},
        }
        states = {name: np.stack([paths.states[name][:, index] for paths in self._paths]) for name in self._paths[0].states}
        log_weights = np.full((runs, self._draws), -np.log(self._draws), dtype)
        # The first frame took longer: it waited for the compiler.
        ready = 0.0 if index else self._ready
        return FrameResult(states, log_weights, FilterInfo(**info), frame.seen, self._seconds / len(self), ready, frame.restarted)
