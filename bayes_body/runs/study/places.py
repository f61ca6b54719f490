"""Where units run: a protocol, and the places of this machine, as many as cores and memory allow. A thread waits for each unit's process."""

import queue
import threading
from collections.abc import Callable
from contextlib import suppress
from typing import Protocol

from bayes_body.runs.study.attempt import Attempts, Outcome
from bayes_body.runs.study.host import free_bytes
from bayes_body.runs.study.unit_process import Job

# Memory that stays free for the rest of the machine, as a share of what is free at the start.
RESERVE = 0.15
GIGABYTE = 1e9


class Places(Protocol):
    """Somewhere units can run."""

    counts_parents: bool
    """Whether the end of the process that waits for a unit counts as a death of the unit (`Job.counts_parents`)."""

    def expect(self, units: int) -> None:
        """Learn how many units are not done or failed. It is called whenever the driver looks around."""
        ...

    def capacity(self) -> int:
        """Return how many units may run at once now."""
        ...

    def submit(self, job: Job) -> None:
        """Begin a unit."""
        ...

    def ended(self, timeout_s: float) -> list[Outcome]:
        """Return the units that have ended since the last call; wait for one, at most `timeout_s` seconds."""
        ...

    def measure(self) -> None:
        """Learn from the running units how much memory a unit needs. It is called once the first of them has stored a frame."""
        ...

    def describe(self) -> str:
        """Return a line about the places, for the user."""
        ...

    def stop(self) -> None:
        """Let all units end in order, and free what was taken."""
        ...


class LocalPlaces:
    """The places of this machine.

    Args:
        most: most units at once, by cores or GPUs.
        cpus: cores of a unit.
        free: returns the memory that new processes can have, bytes; None if it is not known.
        attempts: starts the processes.
    """

    counts_parents = False

    def __init__(self, most: int, cpus: int, attempts: Attempts | None = None, free: Callable[[], int | None] = free_bytes):
        self._most, self._cpus, self._attempts = max(most, 1), cpus, attempts or Attempts()
        self._free, self._unit_bytes = free(), 0
        self._measured = False
        self._outcomes: queue.SimpleQueue[Outcome] = queue.SimpleQueue()

    def expect(self, units: int) -> None:
        """Do nothing: places of this machine cost nothing while they are free."""

    def capacity(self) -> int:
        """Return one until a unit was measured, then as many as fit."""
        if not self._measured:
            return 1
        if self._free is None or not self._unit_bytes:
            return self._most
        return max(1, min(self._most, int(self._free * (1 - RESERVE) / self._unit_bytes)))

    def submit(self, job: Job) -> None:
        """Begin a unit in a thread."""
        threading.Thread(target=lambda: self._outcomes.put(self._attempts.run(job)), name=job.key, daemon=True).start()

    def ended(self, timeout_s: float) -> list[Outcome]:
        """Return the units that have ended since the last call; wait for one, at most `timeout_s` seconds."""
        outcomes: list[Outcome] = []
        with suppress(queue.Empty):
            outcomes.append(self._outcomes.get(timeout=timeout_s))
            while True:
                outcomes.append(self._outcomes.get_nowait())
        for outcome in outcomes:
            if outcome.record is not None:
                self._unit_bytes = max(self._unit_bytes, outcome.record.peak_bytes)
        self._measured = self._measured or any(outcome.record is not None for outcome in outcomes)
        return outcomes

    def measure(self) -> None:
        """Take the largest memory of the running units as that of a unit."""
        self._unit_bytes, self._measured = max(self._unit_bytes, *self._attempts.peaks().values(), 0), True

    def describe(self) -> str:
        """Return a line such as `2 units at once, with one core each (a unit needs 0.9 GB, 18 GB are free)`."""
        cores = "one core each" if self._cpus == 1 else f"{self._cpus} cores each"
        memory = f" (a unit needs {self._unit_bytes / GIGABYTE:.1f} GB" if self._unit_bytes else ""
        memory += f", {self._free / GIGABYTE:.0f} GB are free)" if memory and self._free is not None else ")" if memory else ""
        count = self.capacity()
        return f"{count} unit{'s' if count > 1 else ''} at once, with {cores}{memory}"

    def stop(self) -> None:
        """Let all units end in order."""
        self._attempts.stop()
