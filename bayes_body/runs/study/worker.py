"""What a worker of a Dask cluster does for a study: it starts the process of a unit and waits. It loads neither JAX nor Dask itself.

The functions run in the worker, and are sent by name: a worker must have the same bayes_body as the driver.
"""

import asyncio
import threading
from importlib.metadata import version
from pathlib import Path
from platform import node
from typing import Any, NamedTuple

from filelock import FileLock, Timeout

from bayes_body.runs.study.attempt import PROGRAM, Attempts, Outcome
from bayes_body.runs.study.host import free_bytes, gpus
from bayes_body.runs.study.records import STOPPED
from bayes_body.runs.study.unit_process import Job


class Inspection(NamedTuple):
    """What a worker says about itself.

    Attributes:
        name: its name in the cluster.
        host: name of its machine.
        version: of its bayes_body.
        token: what the driver's file says there; empty if the file is not there.
        lock: "seen" if the driver's lock holds there, "free" if it does not, else why nothing can be locked.
        gpus: number of GPUs that its units may use.
        free_bytes: memory that new processes can have; None if it is not known.
    """

    name: str
    host: str
    version: str
    token: str
    lock: str
    gpus: int
    free_bytes: int | None


async def inspect_worker(path: str, dask_worker: Any = None) -> Inspection:
    """Return what the driver must know before it gives units to this worker.

    Args:
        path: of the file in the folder of the study into which the driver has written its token. Beside it lies the lock that the driver holds.
        dask_worker: the worker; Dask fills it in.
    """
    try:
        token = Path(path).read_text(encoding="utf-8")
    except OSError:
        token = ""
    lock = _state_of_lock(f"{path}.lock") if token else ""
    # nvidia-smi may take a second.
    count = len(await asyncio.to_thread(gpus))
    return Inspection(str(dask_worker.name), node(), version("bayes-body"), token, lock, count, free_bytes())


def _state_of_lock(path: str) -> str:
    lock = FileLock(path, timeout=0, is_singleton=False)
    try:
        lock.acquire()
    except Timeout:
        return "seen"
    except (OSError, NotImplementedError) as error:
        return str(error)
    lock.release()
    return "free"


class _Registry:
    """The processes that this worker has started, by the driver that asked for them."""

    def __init__(self) -> None:
        self._attempts: dict[str, Attempts] = {}
        self._stopped: set[str] = set()
        self._lock = threading.Lock()

    def attempts(self, driver: str, program: tuple[str, ...]) -> Attempts | None:
        """Return those of a driver; None once it has stopped."""
        with self._lock:
            return None if driver in self._stopped else self._attempts.setdefault(driver, Attempts(program))

    def stop(self, driver: str) -> None:
        """End those of a driver, in a thread: the worker does not wait for them."""
        with self._lock:
            self._stopped.add(driver)
            attempts = self._attempts.pop(driver, None)
        if attempts is not None:
            threading.Thread(target=attempts.stop, name=f"stop {driver}", daemon=True).start()


_registry = _Registry()


def run_job(text: str, driver: str, program: tuple[str, ...] = PROGRAM) -> Outcome:
    """Compute a unit in a process of its own, and wait for its end.

    Args:
        text: a job, as `Job.to_text` writes it.
        driver: the token of the driver.
        program: what Python executes in that process.
    """
    job = Job.from_text(text)
    attempts = _registry.attempts(driver, tuple(program))
    return Outcome(job.key, STOPPED) if attempts is None else attempts.run(job)


def stop_jobs(driver: str) -> None:
    """Let all units of a driver end in order, and begin no other."""
    _registry.stop(driver)
