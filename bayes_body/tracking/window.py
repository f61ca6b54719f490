"""The joint posterior of a window of frames of a filtered session, by NUTS (kernels/paths/window.py).

The filter's particles in the frame before the window give the prior. The chains start from the smoother's paths, and move in coordinates fitted to
these paths. Paths and chains both use the images up to the end of the window and no later ones, so the paths and the draws have the same
distribution. The runs of a filter count together, as one sample.
"""

import time
from contextlib import closing
from typing import Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from bayes_body.base.errors import input_error
from bayes_body.base.shapes import Key
from bayes_body.density.ahead import sampled_of
from bayes_body.density.density import Density
from bayes_body.density.factor import Particles, State
from bayes_body.density.frames import stacked
from bayes_body.density.trajectory import trajectory
from bayes_body.kernels.batching import everywhere
from bayes_body.kernels.paths.smoother import build_smoother
from bayes_body.kernels.paths.window import WindowDraws, sample_window
from bayes_body.kernels.paths.window_evidence import WindowEvidence, window_evidence
from bayes_body.kernels.smc.moves import check_gradients
from bayes_body.model.build import Model
from bayes_body.recording.session.session import Session
from bayes_body.tracking.draws import Frames
from bayes_body.tracking.observations import observations
from bayes_body.tracking.smooth import smooth_window

type Prior = Literal["gaussian", "particles"]


class WindowPosterior(NamedTuple):
    """The posterior of a window.

    Attributes:
        model: the model.
        frames: the numbers of the frames in the recording.
        draws: the trajectories and the figures of the chains.
        paths: whole states of the smoother's paths (path, frame, ...), all runs together.
        evidence: the log-evidence of the window given the images before it, up to the likelihood's constant, and that of potentials.
        seconds: wall-clock seconds of the smoother and of the chains, compilation included.
    """

    model: Model
    frames: range
    draws: WindowDraws
    paths: State
    evidence: WindowEvidence
    seconds: tuple[float, float]


def window_posterior(
    session: Session,
    model: Model,
    filtered: Frames,
    frames: range,
    key: Key,
    prior: Prior = "gaussian",
    paths: int = 250,
    moves: int = 3,
    **options: int | float | str,
) -> WindowPosterior:
    """Draw trajectories from the joint posterior of consecutive frames.

    Args:
        session: the recording.
        model: the model with which the session was filtered.
        filtered: the frames of the filters; their kernel must sample the posterior.
        frames: the frames, counted from 0.
        key: random key.
        prior: the prior of the first frame. `gaussian`: one Gaussian with the moments of the filter's prediction, as in a filter with
            `prediction = "gaussian"`. `particles`: the mixture of the particles' predictions, for models with few dofs.
        paths: number of the smoother's paths for each run of the filter.
        moves: number of times that the smoother moves each state.
        options: those of `kernels.window.Options`: chains, warm_up, draws, metric, target_acceptance.

    Raises:
        InputError: the window is not inside the recording or has no frame before it, a run started anew in it, NUTS cannot sample the model's
            density, an option is out of its range, or a frame cannot be read.
    """
    _check(model, filtered, frames, session.first_frame)
    started = time.perf_counter()
    smooth_key, prior_key, run_key = jax.random.split(key, 3)
    smoothed = smooth_window(session, model, build_smoother(draws=paths, moves=moves), filtered, smooth_key, frames)
    names = smoothed[0].states
    by_path = {name: _pooled(np.stack([np.asarray(smoothed_frame.states[name]) for smoothed_frame in smoothed], axis=2)) for name in names}
    path_states = _on_one_turn(model, {name: jnp.asarray(values) for name, values in by_path.items()})
    ready = time.perf_counter()

    particles = _pooled_particles(filtered, frames.start - 1)
    with closing(observations(session, model, frames)) as observed:
        densities = [Density(model.transition, model.factors if o.factors is None else o.factors, o.data, particles) for o in observed]
    first = jax.tree.map(lambda leaf: leaf[0], path_states)
    target = trajectory(stacked(densities), particles, first, gaussian=prior_key if prior == "gaussian" else None)
    draws = jax.block_until_ready(sample_window(run_key, target, path_states, None, **options))
    evidence = window_evidence(jax.random.fold_in(key, 1), target, draws)
    numbers = range(session.frame_number(frames.start), session.frame_number(frames.stop))
    return WindowPosterior(model, numbers, draws, path_states, evidence, (ready - started, time.perf_counter() - ready))


def _pooled_particles(filtered: Frames, frame: int) -> Particles:
    """Return the particles of a frame, all runs together."""
    frame_result = filtered[frame]
    states = {name: jnp.asarray(_pooled(np.asarray(values))) for name, values in frame_result.states.items()}
    log_weights = jnp.asarray(_pooled(frame_result.log_weights))
    return everywhere(Particles(states, log_weights - jnp.log(len(frame_result.log_weights))))


def _pooled(values: np.ndarray) -> np.ndarray:
    """Return an array (run, draw, ...) as (draw, ...)."""
    return values.reshape(-1, *values.shape[2:])


def _on_one_turn(model: Model, paths: State) -> dict[str, jax.Array]:
    """Return paths (path, frame, ...) whose angles on the circle are within half a turn of those of the first path."""
    transition = model.transition

    def unwrap(state: State, centre: State) -> State:
        sampled = transition.near(sampled_of(transition, state), centre)
        return {**state, **transition.with_derived(sampled)}

    first = jax.tree.map(lambda leaf: leaf[0], dict(paths))
    return jax.jit(jax.vmap(jax.vmap(unwrap), in_axes=(0, None)))(dict(paths), first)


def _check(model: Model, filtered: Frames, frames: range, first: int) -> None:
    last = len(filtered) - 1
    if not len(frames) or frames.step != 1 or not 1 <= frames.start <= frames[-1] <= last:
        problem, expected = f"{first + frames.start} to {first + frames.stop - 1}", f"consecutive frames from {first + 1} to {first + last}"
        raise input_error("the frames of the window", problem, expected, f"give others; frame {first} has no frame before it")
    check_gradients(Density(model.transition, model.factors, {}, _pooled_particles(filtered, frames.start - 1)), "NUTS")
    restarted = [frame for frame in frames if filtered[frame].restarted.any()]
    if restarted:
        problem = f"the filter started anew in frame {first + restarted[0]}"
        raise input_error("the frames of the window", problem, "frames through which all runs go on", "choose a window before or after it")
