"""Places of a study on the workers of a Dask cluster.

Each unit is given to a certain worker, and as many as it has places for. So a worker with another bayes_body, or without the disk of the study, gets
none, and a worker that goes away is known to have been the one of its units: they begin again elsewhere, and Dask itself repeats nothing.
"""

import queue
import time
from collections import Counter
from collections.abc import Callable
from contextlib import suppress
from typing import NamedTuple, Protocol

from distributed import Client, Future

from bayes_body.runs.study.attempt import DIED, ELSEWHERE, GRACE_S, PROGRAM, Outcome
from bayes_body.runs.study.dask_workers import DaskWorkers
from bayes_body.runs.study.driver import Share, Show
from bayes_body.runs.study.driver_file import DriverFile
from bayes_body.runs.study.places import RESERVE
from bayes_body.runs.study.records import STOPPED
from bayes_body.runs.study.unit_process import Job
from bayes_body.runs.study.worker import Inspection, run_job, stop_jobs
from bayes_body.view.study.rows import FAILED

# Seconds for an answer about a task.
ANSWER_S = 20.0


class Running(NamedTuple):
    """A unit that was given to a worker."""

    job: Job
    address: str
    future: Future


class Deployment(Protocol):
    """What starts the workers."""

    def expect(self, units: int, workers: set[str], busy: set[str]) -> None:
        """Ask for as many workers as there are units to compute, and give up those that have none.

        Args:
            units: number of units that are not done.
            workers: names of the workers that are there.
            busy: names of those that compute.

        Raises:
            InputError: no worker can be had.
        """
        ...

    def close(self) -> None:
        """End all workers that it has started."""
        ...


class RunningCluster:
    """A cluster that somebody else has started, and that stays."""

    def expect(self, units: int, workers: set[str], busy: set[str]) -> None:
        """Do nothing."""

    def close(self) -> None:
        """Do nothing."""


class DaskPlaces:
    """The places of a cluster.

    Args:
        client: is connected to the scheduler, and closed by `stop`.
        address: of the scheduler, for sentences.
        deployment: starts the workers, and is closed by `stop`.
        file: by which a worker is tested for the disk of the study.
        share: what a unit gets.
        at_once: most units at once; None for as many as there are places.
        unit_bytes: memory of a unit, as far as it is known before one has ended; 0 if it is not.
        show: receives lines for the user.
        program: what Python executes for a unit.
    """

    counts_parents = True

    def __init__(
        self,
        client: Client,
        address: str,
        deployment: Deployment,
        file: DriverFile,
        share: Share,
        at_once: int | None,
        unit_bytes: int,
        show: Show,
        program: tuple[str, ...] = PROGRAM,
    ):
        self._client, self._address, self._deployment, self._file = client, address, deployment, file
        self._share, self._at_once, self._program = share, at_once, program
        self._workers = DaskWorkers(client, address, file, share.gpus, show)
        self._running: dict[str, Running] = {}
        self._ended: queue.SimpleQueue[Callable[[], Outcome | None]] = queue.SimpleQueue()
        self._unit_bytes, self._submitted = unit_bytes, 0
        self._is_stopped = False

    def inspect(self) -> list[Inspection]:
        """Look at the workers that are there now, and return what those say that can compute units.

        Raises:
            InputError: there are some, and none of them can; or the scheduler has gone.
        """
        self._workers.wait()
        return [worker.inspection for worker in self._workers.able.values()]

    def assign(self, share: Share) -> None:
        """Change what a unit gets."""
        self._share = share
        self._workers.require_gpus(share.gpus)

    def expect(self, units: int) -> None:
        """Ask for as many workers as there are units that are not done.

        Raises:
            InputError: no worker can be had, or those that have come cannot compute units; or the scheduler has gone.
        """
        self._workers.look()
        self._workers.check()
        able = self._workers.able
        busy = {able[unit.address].inspection.name for unit in self._running.values() if unit.address in able}
        most = units if self._at_once is None else min(units, self._at_once)
        self._deployment.expect(most, self._workers.names, busy)

    def capacity(self) -> int:
        """Return how many units may run at once now.

        Raises:
            InputError: the scheduler has gone.
        """
        self._workers.look()
        count = sum(self._slots().values())
        return count if self._at_once is None else min(count, self._at_once)

    def submit(self, job: Job) -> None:
        """Give a unit to the worker with most free places."""
        taken = Counter(unit.address for unit in self._running.values())
        slots = self._slots()
        address = max(slots, key=lambda name: slots[name] - taken[name], default=None)
        if address is None:
            self._ended.put(lambda: Outcome(job.key, ELSEWHERE))
            return
        self._submitted += 1
        key = f"bayes-body-{self._file.token}-{self._submitted}"
        arguments = (job.to_text(), self._file.token, self._program)
        future = self._client.submit(run_job, *arguments, key=key, workers=[address], allow_other_workers=False, pure=False, retries=0)
        self._running[job.key] = Running(job, address, future)
        future.add_done_callback(lambda done: self._ended.put(lambda: self._outcome(job.key, done)))

    def ended(self, timeout_s: float) -> list[Outcome]:
        """Return the units that have ended since the last call; wait for one, at most `timeout_s` seconds.

        Raises:
            InputError: the scheduler has gone.
        """
        outcomes = self._abandon()
        with suppress(queue.Empty):
            entry = self._ended.get(timeout=0 if outcomes else timeout_s)
            while True:
                outcome = entry()
                outcomes += [outcome] if outcome is not None else []
                entry = self._ended.get_nowait()
        for outcome in outcomes:
            self._running.pop(outcome.key, None)
            if outcome.record is not None:
                self._unit_bytes = max(self._unit_bytes, outcome.record.peak_bytes)
        return outcomes

    def measure(self) -> None:
        """Do nothing: how much memory a unit needs is said by the cluster's file, or known when the first has ended."""

    def describe(self) -> str:
        """Return a line such as `12 units at once on 12 workers of tcp://head:8786, with one core each`."""
        count, workers = self.capacity(), len(self._workers.able)
        cores = "one core each" if self._share.cpus == 1 else f"{self._share.cpus} cores each"
        gpu = " and a GPU" if self._share.gpus else ""
        return (
            f"{count} unit{'s' if count != 1 else ''} at once on {workers} worker{'s' if workers != 1 else ''} of {self._address}, with {cores}{gpu}"
        )

    def stop(self) -> None:
        """Let all units end in order, and end the workers that were started for them."""
        if self._is_stopped:
            return
        self._is_stopped = True
        try:
            self._stop_units()
        finally:
            with suppress(Exception):
                self._client.close(timeout=5)
            self._deployment.close()
            self._file.close()

    def _stop_units(self) -> None:
        if not self._running or self._workers.is_lost:
            return
        # A scheduler or a worker that has gone ends its units by itself: their standard input is closed.
        with suppress(Exception):
            addresses = [address for address in {unit.address for unit in self._running.values()} if address in self._workers.able]
            self._client.run(stop_jobs, self._file.token, workers=addresses, on_error="ignore", callback_timeout=10)
            deadline = time.monotonic() + GRACE_S + 5
            while time.monotonic() < deadline and not all(unit.future.done() for unit in self._running.values()):
                time.sleep(0.1)
            self._client.cancel([unit.future for unit in self._running.values()])

    def _slots(self) -> dict[str, int]:
        """Return the number of units of each worker. A thread counts as a core; a worker with fewer cores than a unit wants gets one."""
        on_host = Counter(worker.inspection.host for worker in self._workers.able.values())
        slots = {}
        for address, (inspection, threads) in self._workers.able.items():
            count = max(1, threads // self._share.cpus)
            if self._share.gpus:
                count = min(count, inspection.gpus)
            if self._unit_bytes and inspection.free_bytes is not None:
                free = inspection.free_bytes * (1 - RESERVE) / on_host[inspection.host]
                count = min(count, max(1, int(free / self._unit_bytes)))
            slots[address] = count
        return slots

    def _outcome(self, key: str, future: Future) -> Outcome | None:
        """Return how a task ended; None if its unit was given up before."""
        running = self._running.get(key)
        if running is None or running.future is not future:
            return None
        if future.status == "finished":
            try:
                return future.result(timeout=ANSWER_S)
            except Exception:
                # The worker went before its answer was here. What it did is on the disk.
                return Outcome(key, ELSEWHERE)
        if future.status != "error":
            # Cancelled: the connection to the scheduler was lost, and the unit may still run. Lost: the worker went, with its answer.
            return Outcome(key, STOPPED if self._is_stopped else ELSEWHERE)
        error = future.exception(timeout=ANSWER_S)
        if type(error).__name__ == "KilledWorker":
            return Outcome(key, DIED, running.job.files.read(), self._death(running))
        return Outcome(key, FAILED, None, f"the worker {running.address} could not begin it: {type(error).__name__}: {error}")

    def _abandon(self) -> list[Outcome]:
        """Give up the units whose worker is not there any longer."""
        self._workers.look()
        lost = [unit for unit in self._running.values() if unit.address not in self._workers.able and not unit.future.done()]
        for unit in lost:
            del self._running[unit.job.key]
            with suppress(Exception):
                unit.future.cancel()
        return [Outcome(unit.job.key, DIED, unit.job.files.read(), self._death(unit)) for unit in lost]

    def _death(self, unit: Running) -> str:
        return f"its worker {unit.address} has gone, because it was killed or its time was over."
