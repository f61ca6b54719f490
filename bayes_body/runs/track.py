"""Track a session from a script, say what the command line says at its end, and smooth: `bayes_body.track` and `bayes_body.smooth`."""

import sys
import warnings
from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import replace

import jax
import numpy as np
from pydantic import BaseModel

from bayes_body.base.errors import RunWarning, input_error
from bayes_body.base.progress import waiting, watched
from bayes_body.base.registry import names
from bayes_body.base.shapes import Key
from bayes_body.density.kernel import Kernel
from bayes_body.kernels.paths.smoother import JointOptions, Smoother, paths_options
from bayes_body.model.build import Model
from bayes_body.model.kernel_options import kernel_sentences, unknowns_sentence
from bayes_body.recording.session.session import Session
from bayes_body.results.metrics.by_frame import stack_frames
from bayes_body.results.metrics.fit import frame_fit, result_fit
from bayes_body.results.metrics.plausibility import fit_figures, judge
from bayes_body.results.metrics.plausibility_sentences import fit_sentences
from bayes_body.results.metrics.unknown_sentences import unknown_sentences
from bayes_body.results.metrics.unknowns import near_limit_shares, near_limits, unknown_figures
from bayes_body.results.posterior.diagnostics import Thresholds, diagnose, sentences
from bayes_body.results.posterior.joint_sentences import joint_sentences
from bayes_body.results.posterior.stream import tree_on_demand
from bayes_body.runs.finish import pair_remarks
from bayes_body.runs.joint import check_joint, joint_paths
from bayes_body.runs.other_figures import near_body, observations_near_body
from bayes_body.runs.progress import progress_bar, smoothing_bar
from bayes_body.tracking import smooth as smoothing
from bayes_body.tracking import track as tracking
from bayes_body.tracking.draws import Draws, FrameStore, timing_of
from bayes_body.tracking.program import Ahead
from bayes_body.tracking.restarts import Recovery
from bayes_body.tracking.smooth import SmoothProgress
from bayes_body.tracking.track import Progress

ORDER = "track(key, session, model, kernel=None, ...)"


def track(
    key: Key,
    session: Session,
    model: Model,
    kernel: Kernel | None = None,
    particles: int | None = None,
    runs: int = 1,
    frames: int | None = None,
    on_frame: Callable[[Progress], None] | None = None,
    into: FrameStore | None = None,
    ahead: Ahead | None = None,
    recovery: Recovery | None = None,
) -> Draws:
    """Filter a session, and warn of what makes the result doubtful.

    The sentences are those that the command line prints at its end. They are in `warnings` of the result, and each is shown as a `RunWarning`. A
    warning before the run names settings of the model's definition that the kernel leaves out, or unknowns that it follows by its particles.

    Args:
        key: random key of the whole run; each filter and frame folds its own key from it.
        session: the recording.
        model: from `bayes_body.load_model`, for this session.
        kernel: by default the model's own, `model.kernel()`. `model.kernel(moves=2)` changes single options, `bayes_body.kernels.sir()` has none of
            the model's.
        particles: number of particles per run; by default the kernel's option `particles`, or 1000 if it has no options.
        runs: independent filters; ArviZ's chains.
        frames: number of frames to track, from the first; all by default.
        on_frame: called after each frame is stored; by default a terminal shows a progress bar.
        into: the store of the frames, such as `storage.FrameFiles`; a list by default. Frames that it already holds are not computed again: the
            filters continue from the last of them.
        ahead: the result of `compiled_ahead` for this session and kernel, and for a model of the same form.
        recovery: finds the person again after a loss, such as `runs.recovery.PersonRecovery`; by default a lost run stays lost.

    Raises:
        InputError: arguments in another order; no particles, runs or frames; `into` holds other numbers of them; a frame's images cannot be read, or
            a frame cannot be stored; no Markov chain of a frame accepts a move.
    """
    _check_order(key, session, model, kernel)
    bar, store = sys.stderr.isatty(), [] if into is None else into
    for sentence in () if kernel is None else (settings_left_out(model, kernel, particles), _unknowns_warning(model, kernel)):
        if sentence:
            warnings.warn(sentence, RunWarning, stacklevel=2)
    with progress_bar(done=len(store)) if bar and on_frame is None else nullcontext(on_frame) as show:
        wanted = range(len(store), session.frames if frames is None else frames)
        arriving = observations_near_body(session, model, model.kernel() if kernel is None else kernel, wanted, store)
        draws = tracking.track(key, session, model, kernel, particles, runs, frames, show, store, ahead, recovery, arriving)
    draws = replace(draws, warnings=tuple(run_sentences(session, draws, bar)))
    for sentence in draws.warnings:
        warnings.warn(sentence, RunWarning, stacklevel=2)
    return draws


def smooth(key: Key, session: Session, filtered: Draws, on_frame: Callable[[SmoothProgress], None] | None = None, **options: int | str) -> Draws:
    """Draw paths through all frames, given all images: the joint posterior, where `track` has each frame's given the images up to it.

    Args:
        key: random key of all paths.
        session: the recording that was tracked.
        filtered: what `track` returned for it.
        on_frame: called after each frame, the last one first; by default a terminal shows a progress bar.
        options: those of `kernels.paths.smoother.Options`: draws, start, moves, leapfrog_steps, candidates. Runs of the kernel `laplace` have
            `start="gaussian"` and `moves=0` by default. With `start="joint"`, which has `draws` only, all paths are drawn from one Gaussian of all
            frames at once. Then `on_frame` is not called, and what makes the Gaussian doubtful is in `warnings` and shown as `RunWarning`.

    Returns:
        one path a draw, of equal weight, with its frames in the order of time.

    Raises:
        InputError: the kernel that filtered seeks modes, an option does not exist or is outside its range, or a frame cannot be read; with
            `start="joint"` also: a run started anew, the model has no such Gaussian, or the memory is too small.
    """
    if not filtered.samples_posterior:
        raise input_error("smooth: the draws", "their kernel seeks modes", "a sample of the posterior", "track with another kernel, such as tempered")
    chosen = paths_options(filtered.kernel, options)
    if isinstance(chosen, JointOptions):
        return _joint(key, session, filtered, chosen)
    with smoothing_bar() if sys.stderr.isatty() and on_frame is None else nullcontext(on_frame) as show:
        model = near_body(session, filtered.model, filtered.frames)
        paths = smoothing.smooth(session, model, Smoother(chosen), filtered.frames, key, [], show)
    return replace(filtered, frames=paths, timing=timing_of(paths), warnings=(), smoothed=True)


def _joint(key: Key, session: Session, filtered: Draws, options: JointOptions) -> Draws:
    """Return paths from one Gaussian of all frames, and warn of what makes it doubtful."""
    restarted = [session.frame_number(index) for index in filtered.frames_restarted]
    check_joint(session, filtered.model, len(filtered.frames), filtered.runs, options.draws, restarted)
    paths = joint_paths(session, near_body(session, filtered.model, filtered.frames), options, filtered.frames, key, [], sys.stderr.isatty())
    draws = replace(filtered, frames=paths, timing=timing_of(paths), warnings=(), smoothed=True)
    diagnosis = diagnose(tree_on_demand(draws))
    draws = replace(draws, warnings=tuple(joint_sentences(diagnosis, Thresholds())))
    for sentence in draws.warnings:
        warnings.warn(sentence, RunWarning, stacklevel=3)
    return draws


def _kernel_warning(draws: Draws) -> list[str]:
    """Return a warning if the kernel needs more cameras than the recording has."""
    warning = kernel_sentences(draws.model.definition, draws.kernel, draws.model.cameras)[1] if draws.kernel in names("kernel") else ""
    return [warning] if warning else []


def _unknowns_warning(model: Model, kernel: Kernel) -> str:
    """Return a warning if a kernel of the registry follows the model's unknowns by its particles; else nothing."""
    kind, options = getattr(kernel, "kind", None), getattr(kernel, "options", None)
    return unknowns_sentence(kind, options, [term.name for term in model.unknowns]) if kind in names("kernel") and options is not None else ""


def _check_order(key: object, session: object, model: object, kernel: object) -> None:
    """Name the order of the arguments if they have another, such as that of earlier versions."""
    expected = {"key": (key, jax.Array), "session": (session, Session), "model": (model, Model)}
    for name, (value, kind) in expected.items():
        if not isinstance(value, kind):
            problem, remedy = f"a {type(value).__name__}", f"write {ORDER}, with a key such as jax.random.key(0)"
            raise input_error(f"track: {name}", problem, {"key": "a random key"}.get(name, f"a {kind.__name__}"), remedy)
    if kernel is not None and not callable(kernel):
        raise input_error("track: kernel", repr(kernel), "a kernel", 'write model.kernel(), model.kernel("sir") or bayes_body.kernels.sir()')


def settings_left_out(model: Model, kernel: Kernel, particles: int | None = None) -> str:
    """Return a sentence about settings that the model's definition has for this kernel, and that were left out when it was built; empty if none were.

    Args:
        model: the model.
        kernel: such as `bayes_body.kernels.tempered()`. Options that were given for it count as meant.
        particles: a number of particles that is given besides.
    """
    kind, options, model_kernel = getattr(kernel, "kind", None), getattr(kernel, "options", None), model.definition.kernel
    if kind != model_kernel.kind or not isinstance(options, BaseModel):
        return ""
    meant = options.model_fields_set | ({"particles"} if particles is not None else set())
    values = {name: (getattr(options, name), getattr(model_kernel.options, name)) for name in type(options).model_fields if name not in meant}
    changed = [f"{name} is {value!r}, not {wanted!r}" for name, (value, wanted) in values.items() if value != wanted]
    if not changed:
        return ""
    remedy = f"use model.kernel(), or give these options to {kind}() if you mean them"
    return f"the kernel {kind}() leaves out settings of the model '{model.definition.name}': {', '.join(changed)}; {remedy}."


def run_sentences(session: Session, draws: Draws, bar: bool = False) -> list[str]:
    """Return the warnings about a run, most serious first; none for a valid run.

    Args:
        session: the recording.
        draws: of this session. Their frames are read a few at a time.
        bar: whether to draw progress bars on standard error.

    Raises:
        InputError: a frame's images or file cannot be read.
    """
    model, count = draws.model, len(draws.frames)
    first = frame_fit(session, model, np.asarray(model.initial[model.body.variable], float)[None], 0, to_judge=True)
    frames = watched("figures", bar)(range(count))
    verdicts = stack_frames(judge(result_fit(session, model, draws.frames[index], index, to_judge=True)) for index in frames)
    figures = {"frames": count, "frames_restarted": draws.frames_restarted, **fit_figures(first, verdicts)}
    is_sample = draws.samples_posterior
    figures |= unknown_figures(model, draws.frames[count - 1], count - 1, is_sample)
    figures["near_limit_shares"] = near_limit_shares(model, np.stack([near_limits(model, frame) for frame in draws.frames]) if is_sample else None)
    remarks = pair_remarks(session, model, count, bar)
    with waiting("diagnostics", bar):
        judged = sentences(diagnose(tree_on_demand(draws)))
    return [*fit_sentences(figures), *_kernel_warning(draws), *remarks, *judged, *unknown_sentences(figures)]
