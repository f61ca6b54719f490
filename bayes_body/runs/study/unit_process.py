"""The process of one unit. It reads its job from standard input, and ends when that is closed: then the process that started it has ended.

Cores, threads and the GPU are chosen before JAX is loaded.
"""

import json
import os
import platform
import shlex
import sys
import threading
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path

from filelock import Timeout

from bayes_body.base import program_cache
from bayes_body.base.errors import InputError
from bayes_body.runs.study.host import HostShare, cores, gpu_identities, gpus, peak_bytes
from bayes_body.runs.study.records import STOPPED, Record, UnitFiles, last_complaint
from bayes_body.runs.study.units import is_finished, stored_frames
from bayes_body.view.study.rows import DONE, FAILED, RUNNING
from bayes_body.view.study.thumbnail import write_thumbnail

# Exit statuses of the command line: interrupted and terminated.
STOPPED_STATUSES = (130, 143)
# Exit status if another process computes the unit (EX_TEMPFAIL).
TAKEN = 75
# Verbs that continue what is in their folder.
RESUMED = ("track", "smooth")


@dataclass(frozen=True)
class Job:
    """What a process needs to know to compute a unit.

    Attributes:
        out: the folder of the study.
        session: the session's name.
        name: the unit's name within it.
        commands: command lines of bayes-body.
        folder: the run whose frames tell the progress.
        digest: `Unit.digest`.
        work: `Unit.work`.
        results: `Unit.results`.
        cpus: number of cores.
        gpus: number of GPUs, 0 or 1.
        wide: whether it may use further cores while they are idle, to compile.
        retries: how many deaths without a new frame count as a failure.
        counts_parents: whether the end of the process that started it counts as a death. That of a cluster's worker does, that of a driver does not.
    """

    out: str
    session: str
    name: str
    commands: tuple[tuple[str, ...], ...]
    folder: str
    digest: str
    work: str
    results: tuple[str, ...]
    cpus: int = 1
    gpus: int = 0
    wide: bool = False
    retries: int = 10
    counts_parents: bool = False

    @property
    def key(self) -> str:
        """The unit's name in the study."""
        return f"{self.session}/{self.name}"

    @property
    def files(self) -> UnitFiles:
        """The unit's files in the folder of the study."""
        return UnitFiles(Path(self.out), self.session, self.name)

    def to_text(self) -> str:
        """Return the job as a line of JSON."""
        return json.dumps(asdict(self)) + "\n"

    @classmethod
    def from_text(cls, text: str) -> "Job":
        """Return the job of a line that `to_text` wrote."""
        table = json.loads(text)
        table["commands"] = tuple(tuple(command) for command in table["commands"])
        table["results"] = tuple(table["results"])
        return cls(**{field.name: table[field.name] for field in fields(cls)})


def environment(job: Job) -> dict[str, str]:
    """Return the environment of a unit's process: the number of devices and threads is the same wherever it runs, and so are its draws."""
    variables = dict(os.environ)
    flags = variables.get("XLA_FLAGS", "")
    if "xla_force_host_platform_device_count" not in flags:
        variables["XLA_FLAGS"] = f"{flags} --xla_force_host_platform_device_count={job.cpus}".strip()
    variables |= {"OMP_NUM_THREADS": str(job.cpus), "OPENBLAS_NUM_THREADS": "1", "MKL_NUM_THREADS": str(job.cpus)}
    if not job.gpus:
        variables["CUDA_VISIBLE_DEVICES"] = ""
    return variables


def compute(command_line: Callable[[Sequence[str]], None]) -> None:
    """Compute the unit whose job is on standard input, and end the process with its status.

    Args:
        command_line: runs one command line of bayes-body, and ends with SystemExit.
    """
    job = Job.from_text(sys.stdin.readline())
    lock = job.files.lock
    try:
        lock.acquire()
    except Timeout:
        sys.exit(TAKEN)
    threading.Thread(target=_end_with_parent, args=(job,), name="parent", daemon=True).start()
    try:
        status = _compute(job, command_line)
    except InputError as error:
        # Its state cannot be written.
        print(f"bayes-body: {error}", file=sys.stderr, flush=True)
        status = 2
    sys.exit(status)


def _end_with_parent(job: Job) -> None:
    """End this process when standard input is closed. Everything that it writes is complete or not there, so it may end at once."""
    # Not by sys.stdin: its lock would be held until the end of the process.
    while os.read(0, 1):
        pass
    record = job.files.read()
    if record is not None and record.state == RUNNING and record.process == os.getpid() and not job.counts_parents:
        with suppress(InputError):
            job.files.write(replace(record, state=STOPPED))
    os._exit(STOPPED_STATUSES[1])


def _compute(job: Job, command_line: Callable[[Sequence[str]], None]) -> int:
    """Take cores and a GPU, run the commands, and write the unit's state. Return the exit status."""
    record = _next_record(job)
    job.files.write(record)
    if record.state != RUNNING:
        return 0 if record.state == DONE else 1
    # It is held until the end of the process.
    share = HostShare()
    _take_cores(job, share)
    if job.gpus and not _take_gpu(share):
        job.files.write(replace(record, state=STOPPED))
        return TAKEN
    status, sentence = _run_commands(job, command_line)
    state = STOPPED if status in STOPPED_STATUSES else FAILED if status else DONE
    record = replace(record, state=state, sentence=sentence, seconds=record.seconds + time.time() - record.begun)
    if state != STOPPED:
        # The picture is for the study's page alone.
        with suppress(InputError):
            write_thumbnail(Path(job.folder), job.files.picture)
        hits, misses = program_cache.LOOKUPS["hits"], program_cache.LOOKUPS["misses"]
        record = replace(record, deaths=0, peak_bytes=peak_bytes(os.getpid()), cache_hits=hits, cache_misses=misses)
    job.files.write(record)
    return status


def _next_record(job: Job) -> Record:
    """Return the state with which a unit begins: running; or done, if it is; or failed, if too many of its processes died without a new frame."""
    previous, frames = job.files.read(), stored_frames(Path(job.folder))
    if previous is not None and previous.work != job.work:
        previous = None
    if previous is not None and previous.state == DONE and is_finished(job):
        return previous
    deaths = previous.deaths + 1 if previous is not None and previous.state == RUNNING and frames <= previous.frames else 0
    seconds = 0.0 if previous is None else previous.seconds
    record = Record(RUNNING, job.digest, job.work, platform.node(), os.getpid(), time.time(), seconds, frames, deaths)
    if deaths < job.retries:
        return record
    reason = "often because memory is short: a smaller `at_once` helps then"
    sentence = f"{deaths} processes died one after the other without a new frame, {reason}; what they printed is in {job.files.log}."
    return replace(record, state=FAILED, sentence=sentence, deaths=0)


def _run_commands(job: Job, command_line: Callable[[Sequence[str]], None]) -> tuple[int, str]:
    """Run the commands of a unit. Return the first status that is not 0, and its sentence."""
    log, status, sentence = job.files.log, 0, ""
    begin = log.stat().st_size if log.exists() else 0
    for command in job.commands:
        print(f"\n{time.strftime('%Y-%m-%d %H:%M:%S')} {platform.node()}: bayes-body {shlex.join(command)}", flush=True)
        code = _run(command_line, command)
        if code in STOPPED_STATUSES:
            return code, ""
        if code and not status:
            status, sentence = code, last_complaint(log, begin) or f"exit status {code}; what it printed is in {log}."
        # A run that is not finished has no smoothed one.
        if code and command[0] in RESUMED:
            break
    return status, sentence


def _run(command_line: Callable[[Sequence[str]], None], command: tuple[str, ...]) -> int:
    """Run one command and return its exit status. A run whose folder exists is continued."""
    arguments = list(command)
    if arguments[0] in RESUMED and (Path(arguments[arguments.index("--out") + 1]) / "run.toml").exists():
        arguments.append("--resume")
    try:
        command_line(arguments)
    except SystemExit as stop:
        return stop.code if isinstance(stop.code, int) else int(stop.code is not None)
    return 0


def _take_cores(job: Job, share: HostShare) -> None:
    """Let this process use cores that no other unit of this machine uses; all of them if there are not so many, or to compile."""
    taken = share.take("core", [str(core) for core in cores()], job.cpus)
    if taken and not job.wide and hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, [int(core) for core in taken])


def _take_gpu(share: HostShare) -> bool:
    """Let this process use a GPU that no other unit of this machine uses. Return whether there is one."""
    names = gpu_identities(gpus())
    taken = share.take("gpu", list(names), 1)
    if taken:
        os.environ["CUDA_VISIBLE_DEVICES"] = names[taken[0]]
    return bool(taken)
