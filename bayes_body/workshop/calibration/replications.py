"""Run many replications of experiments: in blocks, on several processes, stored as they finish, so that an interrupted check can continue.

A replication's key depends on its experiment and its number, and each process computes on one device. Its figures are therefore bit-identical
whatever the number of processes, and wherever a check was interrupted.

A file of replications has the settings in its first line, then one line of JSON per block. A truncated line is computed again.
"""

import json
import os
import re
import signal
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from contextlib import contextmanager
from functools import cache
from multiprocessing import get_context
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from bayes_body.base.errors import input_error
from bayes_body.base.files.atomic import refused
from bayes_body.base.progress import Watch, unwatched
from bayes_body.model.plugins.load import plugins_to_blame

SUFFIX = ".partial"


class ReplicationLog:
    """Blocks of replications by experiment and number. With a path, a block is on disk as soon as it is added."""

    def __init__(self, path: Path | None = None, settings: Mapping[str, Any] | None = None):
        """Read the blocks of an existing file.

        Args:
            path: the file; None keeps the blocks in memory.
            settings: the settings of the replications.

        Raises:
            InputError: the file holds replications with other settings, or cannot be read or written.
        """
        self.path, self._blocks = path, {}
        if path is None:
            return
        head, blocks, size = _read(path)
        if head is not None and head != (wanted := json.loads(json.dumps(settings))):
            name = next(key for key in {**head, **wanted} if head.get(key) != wanted.get(key))
            problem, expected = f"replications with {name} = {head.get(name)!r}", f"{name} = {wanted.get(name)!r}"
            raise input_error(path, problem, expected, "use its settings, remove it, or name another file with --json")
        self._blocks = blocks
        if head is None:
            self._write(json.dumps({"settings": settings}), 0)
        elif size < path.stat().st_size:
            self._write("", size)

    def __contains__(self, key: tuple[str, int]) -> bool:
        return key in self._blocks

    def __getitem__(self, key: tuple[str, int]) -> dict[str, np.ndarray]:
        return self._blocks[key]

    def __len__(self) -> int:
        return len(self._blocks)

    def add(self, experiment: str, block: int, figures: dict[str, np.ndarray]) -> None:
        """Store a block.

        Raises:
            InputError: the file cannot be written.
        """
        self._blocks[experiment, block] = figures
        if self.path is not None:
            values = {name: {"type": value.dtype.name, "values": value.tolist()} for name, value in figures.items()}
            self._write(json.dumps({"experiment": experiment, "block": block, "figures": values}))

    def remove(self) -> None:
        """Remove the file, because its content was reported elsewhere."""
        if self.path is not None:
            self.path.unlink(missing_ok=True)

    def _write(self, line: str, size: int | None = None) -> None:
        """Append a line; if `size` is given, after the file's first `size` bytes."""
        assert self.path is not None
        try:
            with self.path.open("ab") as file:
                if size is not None:
                    file.truncate(size)
                file.write(f"{line}\n".encode() if line else b"")
                file.flush()
                os.fsync(file.fileno())
        except OSError as error:
            raise refused(self.path, "written", error) from None


def settings_of(path: Path) -> dict[str, Any] | None:
    """The settings of the replications in a file; None if there are none.

    Raises:
        InputError: the file cannot be read.
    """
    return _read(path)[0]


def _read(path: Path) -> tuple[dict[str, Any] | None, dict[tuple[str, int], dict[str, np.ndarray]], int]:
    """Settings, blocks, and the size in bytes of the complete lines that this class wrote."""
    try:
        content = path.read_bytes()
    except FileNotFoundError:
        return None, {}, 0
    except OSError as error:
        raise input_error(path, f"cannot be read ({error.strerror})", "the replications of a check", "name another file with --json") from None
    head, blocks, size = None, {}, 0
    for line in content.splitlines(keepends=True):
        try:
            entry = json.loads(line)
            if head is None:
                head = entry["settings"]
            else:
                blocks[entry["experiment"], entry["block"]] = {
                    name: np.array(value["values"], value["type"]) for name, value in entry["figures"].items()
                }
        except (ValueError, KeyError, TypeError):
            break
        if not line.endswith(b"\n"):
            break
        size += len(line)
    if head is None and content.strip():
        raise input_error(path, "its first line is not that of a check", "the replications of a check", "remove it, or name another file with --json")
    return head, blocks, size


BLOCK = 10

type Experiment = Callable[..., Any]
type Figures = dict[str, np.ndarray]


class Experiments(NamedTuple):
    """Experiments by name: functions of a key, and of the problem (a pytree) if there is one, to a NamedTuple of arrays."""

    seed: int
    by_name: Mapping[str, Experiment]
    problem: Any = None


type Task = tuple[str, int]
type Compute = Callable[[Sequence[Task]], Iterator[tuple[Task, Figures]]]


def run_replications(
    make: Callable[[], Experiments], counts: Mapping[str, int], jobs: int = 0, log: ReplicationLog | None = None, watch: Watch = unwatched
) -> dict[str, Figures]:
    """Compute the figures of each experiment, with a leading replication axis.

    Args:
        make: builds the experiments; with `jobs` above 0 it is called in each process, and must be picklable.
        counts: number of replications of each experiment.
        jobs: number of processes; 0 computes in this one.
        log: existing blocks, to which new ones are added.
        watch: shows the progress, in blocks.
    """
    with computing(make, jobs) as compute:
        return add_replications(compute, counts, ReplicationLog() if log is None else log, watch)


def add_replications(compute: Compute, counts: Mapping[str, int], log: ReplicationLog, watch: Watch = unwatched) -> dict[str, Figures]:
    """Like `run_replications`, with a function from `computing`: its compiled programs serve several calls with increasing counts."""
    missing = [(name, block) for name, count in counts.items() for block in range(-(-count // BLOCK)) if (name, block) not in log]
    results = compute(missing)
    for _ in watch(range(len(missing))):
        task, figures = next(results)
        log.add(*task, figures)
    return {name: _joined([log[name, block] for block in range(-(-count // BLOCK))], count) for name, count in counts.items()}


def _joined(blocks: Sequence[Figures], count: int) -> Figures:
    return {name: np.concatenate([block[name] for block in blocks])[:count] for name in blocks[0]}


class _Runner:
    """Experiments, each compiled once."""

    def __init__(self, experiments: Experiments):
        self.experiments, self.compiled = experiments, {}
        self.shared = () if experiments.problem is None else (experiments.problem,)

    def __call__(self, name: str, block: int) -> Figures:
        if name not in self.compiled:
            replication = self.experiments.by_name[name]
            self.compiled[name] = jax.jit(lambda keys, shared: jax.lax.map(lambda key: replication(key, *shared), keys))
        place = sorted(self.experiments.by_name).index(name)
        base = jax.random.fold_in(jax.random.key(self.experiments.seed), place)
        keys = jax.vmap(lambda index: jax.random.fold_in(base, index))(np.arange(block * BLOCK, (block + 1) * BLOCK))
        return {field: np.asarray(value) for field, value in self.compiled[name](keys, self.shared)._asdict().items()}


@contextmanager
def computing(make: Callable[[], Experiments], jobs: int = 0) -> Iterator[Compute]:
    """Yield a function that computes blocks, given by experiment and number, in any order. Programs are built when first needed, and kept."""
    if jobs < 1:
        run = cache(lambda: _Runner(make()))
        yield lambda tasks: ((task, run()(*task)) for task in tasks)
        return
    # A process starts when there is a block for it.
    pool = ProcessPoolExecutor(jobs, get_context("spawn"), _begin, (make, os.getpid()))

    def compute(tasks: Sequence[Task]) -> Iterator[tuple[Task, Figures]]:
        futures = {pool.submit(_work, *task): task for task in tasks}
        return ((futures[future], future.result()) for future in as_completed(futures))

    try:
        yield compute
    finally:
        pool.shutdown(wait=False, cancel_futures=True)


# -- in a worker process ------------------------------------------------------------------------------------------------------------------

_make: Callable[[], Experiments] | None = None
_runner: _Runner | None = None


def _begin(make: Callable[[], Experiments], parent: int) -> None:
    global _make
    # The parent process reports an interruption.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with, args=(parent,), daemon=True).start()
    flags = re.sub(r"--xla_force_host_platform_device_count=\d+", "", os.environ.get("XLA_FLAGS", ""))
    os.environ["XLA_FLAGS"] = f"{flags} --xla_cpu_multi_thread_eigen=false".strip()
    from bayes_body.base.config import configure

    configure(devices=1)
    # An error here would break the pool, and nobody would learn which it was: the experiments are built with the first block.
    _make = make


def _end_with(parent: int) -> None:
    """Exit when the parent has gone: a killed parent cannot stop its processes."""
    while os.getppid() == parent:
        time.sleep(1)
    os._exit(1)


def _work(name: str, block: int) -> Figures:
    global _runner
    # The traceback, which names a plugin's line, does not leave the process.
    with plugins_to_blame():
        if _runner is None:
            assert _make is not None
            _runner = _Runner(_make())
        return _runner(name, block)
