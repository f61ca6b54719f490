"""Start the process of a unit and wait for it. A thread of the driver does this, or a task of a cluster's worker, and nothing else."""

import signal
import subprocess
import sys
import threading
import time
from contextlib import suppress
from typing import NamedTuple, TextIO

from bayes_body.base.errors import InputError
from bayes_body.base.files.atomic import make_folder
from bayes_body.runs.study.host import peak_bytes
from bayes_body.runs.study.records import STOPPED, Record, last_complaint
from bayes_body.runs.study.unit_process import TAKEN, Job, environment
from bayes_body.view.study.rows import DONE, FAILED, RUNNING

PROGRAM = ("-m", "bayes_body.cli.unit")
# The driver asks for another try.
DIED, ELSEWHERE = "died", "elsewhere"
# Seconds that a stopped unit has to end in order.
GRACE_S = 20.0


class Outcome(NamedTuple):
    """How an attempt at a unit ended.

    Attributes:
        key: the unit's name in the study.
        state: done, failed, stopped; died: its process was killed; elsewhere: another process computes it.
        record: its state on the disk; None if there is none.
        sentence: why it failed or died; empty otherwise.
    """

    key: str
    state: str
    record: Record | None = None
    sentence: str = ""


class Attempts:
    """The processes of units that this process has started."""

    def __init__(self, program: tuple[str, ...] = PROGRAM):
        self._program = program
        self._running: dict[str, subprocess.Popen[str]] = {}
        self._lock, self._stopping = threading.Lock(), False

    def run(self, job: Job) -> Outcome:
        """Compute a unit in a fresh process, and wait for its end. No exception leaves this function: a unit stops nothing else."""
        files = job.files
        try:
            if files.is_locked():
                return Outcome(job.key, ELSEWHERE)
            make_folder(files.log.parent)
            with files.log.open("a", encoding="utf-8") as log:
                begin = log.tell()
                status = self._wait(job, log)
        except (OSError, InputError) as error:
            return Outcome(job.key, FAILED, None, str(error))
        record = files.read()
        if status == TAKEN:
            return Outcome(job.key, ELSEWHERE)
        if self._stopping:
            return Outcome(job.key, STOPPED, record)
        if status < 0:
            return Outcome(job.key, DIED, record, f"its process was ended by {_signal_name(-status)}; what it printed is in {files.log}.")
        if record is None or record.state == RUNNING:
            # It could not write its state: the disk is full.
            why = last_complaint(files.log, begin) or f"its process ended with status {status}; what it printed is in {files.log}."
            return Outcome(job.key, FAILED, record, why)
        if record.state == STOPPED:
            return Outcome(job.key, DIED, record, "its process was stopped by somebody else.")
        return Outcome(job.key, DONE if status == 0 else FAILED, record, record.sentence)

    def peaks(self) -> dict[str, int]:
        """Return the largest memory that each running unit has had, bytes, by the unit's name in the study."""
        with self._lock:
            processes = {key: process.pid for key, process in self._running.items()}
        return {key: peak_bytes(number) for key, number in processes.items()}

    def stop(self) -> None:
        """Let all units end in order; those that do not are killed."""
        self._stopping = True
        with self._lock:
            processes = list(self._running.values())
        for process in processes:
            process.terminate()
        deadline = time.monotonic() + GRACE_S
        for process in processes:
            try:
                process.wait(max(0.0, deadline - time.monotonic()))
            except subprocess.TimeoutExpired:
                process.kill()

    def _wait(self, job: Job, log: TextIO) -> int:
        # In a process group of its own: Ctrl-C reaches the driver only, which ends its units in order.
        process = subprocess.Popen(
            [sys.executable, *self._program],
            stdin=subprocess.PIPE,
            stdout=log,
            stderr=subprocess.STDOUT,
            env=environment(job),
            text=True,
            start_new_session=True,
        )
        pipe = process.stdin
        assert pipe is not None
        with self._lock:
            self._running[job.key] = process
        try:
            # A process that has ended already says why by its status.
            with suppress(BrokenPipeError):
                pipe.write(job.to_text())
                pipe.flush()
            if self._stopping:
                process.terminate()
            return process.wait()
        finally:
            with self._lock:
                del self._running[job.key]
            # The pipe is open until here: the unit ends with this process.
            with suppress(OSError):
                pipe.close()


def _signal_name(number: int) -> str:
    try:
        return f"signal {number} ({signal.Signals(number).name})"
    except ValueError:
        return f"signal {number}"
