"""The compiled program of a frame. It is compiled once, for arguments of one form, so that it cannot be traced again.

Arguments of another form are an error, not a silent second compilation. The form of a model is known before its first pose. So `compiled_ahead`
compiles in a thread while the pose is fitted, on the core that the fit leaves idle.

Most kernels have many particles, and all devices share those of one run after the other. A kernel with few would wait for the other devices longer
than it computes. It declares so in the registry (`runs_together`), and the devices share the runs: each computes one run at a time, alone. On an
accelerator all runs are one batch, since the particles of one run do not fill it (docs/decisions/54_gpu.md).
"""

import threading
from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from contextvars import ContextVar, copy_context
from dataclasses import replace
from typing import Any, Literal, NamedTuple

import jax
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec
from jax.stages import Lowered
from jaxtyping import Array

from bayes_body.base.registry import find, names
from bayes_body.base.shapes import Key, Keys
from bayes_body.density.density import Density
from bayes_body.density.factor import Particles
from bayes_body.density.kernel import FilterInfo, Kernel, KernelWithFallback, NamedKernel
from bayes_body.kernels.batching import DEVICES, accelerator_memory, everywhere, replicated, several_runs
from bayes_body.model.build import Model
from bayes_body.recording.observation.frames import read_frame
from bayes_body.recording.session.session import Session
from bayes_body.tracking.proposing import proposer_for

# (key of the run, number of the frame, particles, density) -> particles and information; the first and third for several runs if they are stacked.
type Step = Callable[..., tuple[Particles, FilterInfo]]


class Layout(NamedTuple):
    """How runs lie on the devices.

    Attributes:
        runs: number of runs.
        devices: number of devices that share the runs; 0 if all devices share the particles of each run.
        is_batch: whether all runs are computed at once, as one batch.
    """

    runs: int
    devices: int
    is_batch: bool = False

    @property
    def stacked(self) -> int:
        """Number of runs that one call of the program computes, stacked; 0 if it computes a single one."""
        return self.runs if self.is_batch else self.devices

    def place[Tree](self, tree: Tree) -> Tree:
        """Return what all runs have in common, on every device that is used."""
        return jax.device_put(tree, NamedSharding(self._mesh, PartitionSpec())) if self.devices else everywhere(tree)

    def stacks(self, keys: list[Key], filters: list[Particles]) -> list[tuple[Keys, Particles]]:
        """Return the keys and the particles of all runs for each call of the program. The last call repeats the last run where there are too few."""
        calls = [range(first, first + self.stacked) for first in range(0, self.runs, self.stacked)]
        return [self._stack(*zip(*((keys[run], filters[run]) for run in np.minimum(call, self.runs - 1)), strict=True)) for call in calls]

    def _stack(self, keys: tuple[Key, ...], filters: tuple[Particles, ...]) -> tuple[Keys, Particles]:
        stacked = jax.tree.map(lambda *leaves: np.stack([np.asarray(leaf) for leaf in leaves]), *filters)
        arguments = jax.numpy.stack(keys), stacked
        return everywhere(arguments) if self.is_batch else self.scatter(arguments)

    def scatter[Tree](self, tree: Tree) -> Tree:
        """Return a tree with a leading axis (run,), spread over the devices."""
        return jax.device_put(tree, NamedSharding(self._mesh, PartitionSpec(DEVICES)))

    def spread(self, function: Callable[..., Any]) -> Callable[..., Any]:
        """Return a function of all runs from one of some runs, whose first and third arguments are theirs."""
        by_run, common = PartitionSpec(DEVICES), PartitionSpec()
        return jax.shard_map(function, mesh=self._mesh, in_specs=(by_run, common, by_run, common), out_specs=by_run, check_vma=False)

    @property
    def _mesh(self) -> Mesh:
        return Mesh(np.array(jax.devices()[: self.devices]), (DEVICES,))


type Order = Literal["by the device", "at once", "one by one"]
_ORDER: ContextVar[Order] = ContextVar("order of runs", default="by the device")


@contextmanager
def runs_computed(order: Order) -> Iterator[None]:
    """Compute all runs of a frame at once or one by one in the `with` block, whatever is best on this device: to compare them."""
    token = _ORDER.set(order)
    try:
        yield
    finally:
        _ORDER.reset(token)


def layout_of(kernel: Kernel, runs: int) -> Layout:
    """Return how the runs of a kernel lie on the devices of this process."""
    order = _ORDER.get()
    at_once = accelerator_memory() is not None if order == "by the device" else order == "at once"
    if at_once:
        return Layout(runs, 0, is_batch=runs > 1)
    name = getattr(kernel, "kind", "")
    if name not in names("kernel") or not find("kernel", name).runs_together:
        return Layout(runs, 0)
    return Layout(runs, min(runs, len(jax.devices())))


def side_by_side(runs: int) -> Layout:
    """Return the layout in which the devices share the runs, each with as many as the others."""
    return Layout(runs, max(devices for devices in range(1, min(runs, len(jax.devices())) + 1) if runs % devices == 0))


def parts_of(kernel: Kernel) -> KernelWithFallback | None:
    """Return the parts of a kernel with a fallback; None for other kernels."""
    function = kernel.function if isinstance(kernel, NamedKernel) else kernel
    return function if isinstance(function, KernelWithFallback) else None


class Program(NamedTuple):
    """A compiled step, and the form (tree, shapes and types) of its arguments."""

    step: Step
    form: Any


# The latest programs of this process. Tracing one costs a second or more, even if it is in the compilation cache.
_COMPILED: deque[tuple[Kernel, Program]] = deque(maxlen=8)
_LOCK = threading.Lock()
# The program that is compiled ahead; None if compilation was given up.
type Ahead = Future[Program | None]


def form_of(layout: Layout, key: Key, particles: Particles, density: Density) -> Any:
    """Return a value that is equal for all arguments that one program accepts."""
    leaves, tree = jax.tree.flatten((key, particles, density))
    return layout if layout.stacked else None, tree, tuple((leaf.shape, leaf.dtype) for leaf in leaves)


def traced(kernel: Kernel, layout: Layout, key: Key, particles: Particles, density: Density) -> Lowered:
    """Return the step of one frame, traced but not yet compiled; without the kernel's fallback, if it has one."""
    parts = parts_of(kernel)
    filtered = kernel if parts is None else parts.first

    def frame_of_run(run_key: Key, frame: Array, particles: Particles, density: Density) -> tuple[Particles, FilterInfo]:
        return filtered(jax.random.fold_in(run_key, frame), particles, density.with_previous(particles))

    def frame_of_runs(run_keys: Keys, frame: Array, particles: Particles, density: Density) -> tuple[Particles, FilterInfo]:
        return jax.lax.map(lambda run: frame_of_run(run[0], frame, run[1], density), (run_keys, particles))

    frame = layout.place(np.int32(0))
    if not layout.stacked:
        return jax.jit(frame_of_run, out_shardings=replicated()).lower(key, frame, particles, density)
    keys, filters = layout.stacks([key] * layout.runs, [particles] * layout.runs)[0]
    if not layout.is_batch:
        return jax.jit(layout.spread(frame_of_runs)).lower(keys, frame, filters, density)
    batch = jax.vmap(frame_of_run, (0, None, 0, None))
    with several_runs(layout.runs):
        return jax.jit(batch, out_shardings=replicated()).lower(keys, frame, filters, density)


class Dispatched(NamedTuple):
    """What the devices compute: the outcome of each run; or for each density that was used, the outcomes of the calls that compute all runs."""

    outcomes: list[Any]
    densities: list[int]
    layout: Layout

    def fetch(self) -> tuple[list[tuple[Particles, FilterInfo]], list[Particles]]:
        """Wait for the devices. Return the results of each run on the host, and its particles for the next frame."""
        fetched, stacked = jax.device_get(self.outcomes), self.layout.stacked
        if not stacked:
            return fetched, [after for after, _ in self.outcomes]
        runs = [
            jax.tree.map(lambda leaf, place=run % stacked: leaf[place], fetched[density][run // stacked])
            for run, density in enumerate(self.densities)
        ]
        return runs, [after for after, _ in runs]


def dispatch(step: Step, layout: Layout, keys: list[Key], frame: Any, filters: list[Particles], densities: list[Density]) -> Dispatched:
    """Let the devices compute a frame of all runs.

    Args:
        step: the compiled step.
        layout: how the runs lie on the devices.
        keys: the keys of the runs.
        frame: the number of the frame, on the devices.
        filters: the particles of the runs.
        densities: the density of each run. If runs are stacked, all runs are computed for each different one.
    """
    if not layout.stacked:
        outcomes = [step(key, frame, particles, density) for key, particles, density in zip(keys, filters, densities, strict=True)]
        return Dispatched(outcomes, [], layout)
    calls = layout.stacks(keys, filters)
    distinct = list({id(density): density for density in densities}.values())
    places = [next(place for place, used in enumerate(distinct) if used is density) for density in densities]
    outcomes = [[step(stacked_keys, frame, stacked, density) for stacked_keys, stacked in calls] for density in distinct]
    return Dispatched(outcomes, places, layout)


@contextmanager
def compiled_ahead(session: Session, model: Model, kernel: Kernel, particles: int, runs: int = 1) -> Iterator[Ahead]:
    """Compile the program that will track a session, in a thread. After an error in the `with` block, no further stage of the compilation begins.

    Args:
        session: the recording.
        model: a model with the form of the one that will be tracked; its first pose and lengths may still change.
        kernel: the kernel that will track.
        particles: number of particles per run.
        runs: number of runs.
    """
    given_up = threading.Event()
    # This setting belongs to the caller's thread.
    x64 = bool(jax.config.jax_enable_x64)

    def work() -> Program | None:
        with jax.enable_x64(x64):
            layout = layout_of(kernel, runs)
            key, start = layout.place((jax.random.key(0), model.start(particles)))
            placed = replace(model, transition=layout.place(model.transition), factors=layout.place(model.factors))
            proposer = proposer_for(session, model, kernel)
            proposals = () if proposer is None else layout.place(proposer.empty())
            density = placed.density(layout.place(model.observe(read_frame(session, 0))), start, proposals)
            form = form_of(layout, key, start, density)
            if (known := _known(kernel, form)) is not None:
                return known
            lowered = None if given_up.is_set() else traced(kernel, layout, key, start, density)
            return None if lowered is None or given_up.is_set() else _remembered(kernel, Program(lowered.compile(), form))

    pool = ThreadPoolExecutor(1, thread_name_prefix="compile")
    try:
        # With this thread's choice of the layout.
        yield pool.submit(copy_context().run, work)
    except BaseException:
        given_up.set()
        raise
    finally:
        # Do not wait, since XLA cannot be interrupted.
        pool.shutdown(wait=False)


def program_from(ahead: Ahead | None, kernel: Kernel, layout: Layout, key: Key, particles: Particles, density: Density) -> Step:
    """Return the step that was compiled ahead if it accepts these arguments, else a new one."""
    form = form_of(layout, key, particles, density)
    # An error in the thread occurs again below, where it can be reported.
    if ahead is not None and ahead.exception() is None:
        ready = ahead.result()
        if ready is not None and ready.form == form:
            return ready.step
    program = _known(kernel, form) or _remembered(kernel, Program(traced(kernel, layout, key, particles, density).compile(), form))
    return program.step


def _known(kernel: Kernel, form: Any) -> Program | None:
    """Return the program that this process has already compiled for a kernel and a form."""
    with _LOCK:
        return next((program for compiled_kernel, program in _COMPILED if compiled_kernel is kernel and program.form == form), None)


def _remembered(kernel: Kernel, program: Program) -> Program:
    with _LOCK:
        _COMPILED.append((kernel, program))
    return program
