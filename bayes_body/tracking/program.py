"""The compiled program of a frame. It is compiled once, for arguments of one form, so that it cannot be traced again.

Arguments of another form are an error, not a silent second compilation. The form of a model is known before its first pose. So `compiled_ahead`
compiles in a thread while the pose is fitted, on the core that the fit leaves idle.
"""

import threading
from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import replace
from typing import Any, NamedTuple

import jax
import numpy as np
from jax.stages import Lowered
from jaxtyping import Array

from bayes_body.base.shapes import Key
from bayes_body.density.density import Density
from bayes_body.density.factor import Particles
from bayes_body.density.kernel import FilterInfo, Kernel
from bayes_body.kernels.batching import everywhere, whole
from bayes_body.model.build import Model
from bayes_body.recording.observation.frames import read_frame
from bayes_body.recording.session.session import Session

# (key of the run, number of the frame, particles, density) -> particles and information.
type Step = Callable[..., tuple[Particles, FilterInfo]]


class Program(NamedTuple):
    """A compiled step, and the form (tree, shapes and types) of its arguments."""

    step: Step
    form: Any


# The latest programs of this process. Tracing one costs a second or more, even if it is in the compilation cache.
_COMPILED: deque[tuple[Kernel, Program]] = deque(maxlen=8)
_LOCK = threading.Lock()
# The program that is compiled ahead; None if compilation was given up.
type Ahead = Future[Program | None]


def form_of(key: Key, particles: Particles, density: Density) -> Any:
    """Return a value that is equal for all arguments that one program accepts."""
    leaves, tree = jax.tree.flatten((key, particles, density))
    return tree, tuple((leaf.shape, leaf.dtype) for leaf in leaves)


def traced(kernel: Kernel, key: Key, particles: Particles, density: Density) -> Lowered:
    """Return the step of one frame, traced but not yet compiled."""

    def frame_of_run(run_key: Key, frame: Array, particles: Particles, density: Density) -> tuple[Particles, FilterInfo]:
        return kernel(jax.random.fold_in(run_key, frame), particles, density.with_previous(particles))

    return jax.jit(frame_of_run, out_shardings=whole()).lower(key, everywhere(np.int32(0)), particles, density)


@contextmanager
def compiled_ahead(session: Session, model: Model, kernel: Kernel, particles: int) -> Iterator[Ahead]:
    """Compile the program that will track a session, in a thread. After an error in the `with` block, no further stage of the compilation begins.

    Args:
        session: the recording.
        model: a model with the form of the one that will be tracked; its first pose and lengths may still change.
        kernel: the kernel that will track.
        particles: number of particles per run.
    """
    given_up = threading.Event()
    # This setting belongs to the caller's thread.
    x64 = bool(jax.config.jax_enable_x64)

    def work() -> Program | None:
        with jax.enable_x64(x64):
            key, start = everywhere(jax.random.key(0)), everywhere(model.start(particles))
            placed = replace(model, transition=everywhere(model.transition), factors=everywhere(model.factors))
            density = placed.density(everywhere(model.observe(read_frame(session, 0))), start)
            form = form_of(key, start, density)
            if (known := _known(kernel, form)) is not None:
                return known
            lowered = None if given_up.is_set() else traced(kernel, key, start, density)
            return None if lowered is None or given_up.is_set() else _remembered(kernel, Program(lowered.compile(), form))

    pool = ThreadPoolExecutor(1, thread_name_prefix="compile")
    try:
        yield pool.submit(work)
    except BaseException:
        given_up.set()
        raise
    finally:
        # Do not wait, since XLA cannot be interrupted.
        pool.shutdown(wait=False)


def program_from(ahead: Ahead | None, kernel: Kernel, key: Key, particles: Particles, density: Density) -> Step:
    """Return the step that was compiled ahead if it accepts these arguments, else a new one."""
    form = form_of(key, particles, density)
    # An error in the thread occurs again below, where it can be reported.
    if ahead is not None and ahead.exception() is None:
        ready = ahead.result()
        if ready is not None and ready.form == form:
            return ready.step
    program = _known(kernel, form) or _remembered(kernel, Program(traced(kernel, key, particles, density).compile(), form))
    return program.step


def _known(kernel: Kernel, form: Any) -> Program | None:
    """Return the program that this process has already compiled for a kernel and a form."""
    with _LOCK:
        return next((program for compiled_kernel, program in _COMPILED if compiled_kernel is kernel and program.form == form), None)


def _remembered(kernel: Kernel, program: Program) -> Program:
    with _LOCK:
        _COMPILED.append((kernel, program))
    return program
