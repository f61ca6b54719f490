"""Workers as jobs of a batch system: each job is a worker, and computes one unit after the other until its time is over (dask-jobqueue)."""

import sys
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from shutil import rmtree, which
from tempfile import mkdtemp
from typing import Any, NamedTuple

from dask_jobqueue.core import Job
from dask_jobqueue.htcondor import HTCondorCluster
from dask_jobqueue.lsf import LSFCluster
from dask_jobqueue.pbs import PBSCluster, pbs_format_bytes_ceil
from dask_jobqueue.sge import SGECluster
from dask_jobqueue.slurm import SLURMCluster
from distributed import Security

from bayes_body.base.errors import input_error
from bayes_body.base.files.atomic import make_folder
from bayes_body.runs.study.cluster_file import ClusterFile, CondorTable, QueueTable, SlurmTable, memory_bytes, time_seconds
from bayes_body.runs.study.records import FOLDER

type Show = Callable[[str], None]

# Any: the packages do not say what they take.
CLUSTERS: dict[str, Any] = {
    "dask-slurm": SLURMCluster,
    "dask-pbs": PBSCluster,
    "dask-lsf": LSFCluster,
    "dask-sge": SGECluster,
    "dask-htcondor": HTCondorCluster,
}
# How a line of directives begins.
PREFIXES = {"dask-slurm": "#SBATCH", "dask-pbs": "#PBS", "dask-lsf": "#BSUB", "dask-sge": "#$"}
NAME = "bayes-body"
MOST_JOBS = 50
# A worker ends so long before its job, seconds, or by this share of the job's time, if that is less.
EARLIER_S, EARLIER_SHARE = 120, 0.1
# So often a job may be refused while no other is there: the batch system may be busy for a moment.
MOST_REFUSALS = 4
# Seconds between submissions of jobs that are missing, and until a user is told that no worker has come.
AGAIN_S, SILENT_S = 15.0, 600.0


def batch_job(file: ClusterFile) -> Job:
    """Return the job of a worker, as it would be submitted; the address of the study's scheduler and certificates are known when it has begun."""
    return CLUSTERS[file.kind].job_cls("tls://HOST-OF-THE-STUDY:PORT", name="NAME", **_options(file, None))


def _options(file: ClusterFile, folder: Path | None) -> dict[str, Any]:
    """Return the arguments of dask-jobqueue."""
    memory, seconds, table = memory_bytes(file.memory or ""), time_seconds(file.time or ""), file.batch
    life = seconds - min(EARLIER_S, round(EARLIER_SHARE * seconds))
    options: dict[str, Any] = {
        "job_name": NAME,
        "cores": file.cpus or 1,
        "processes": 1,
        "memory": f"{memory} B",
        "python": sys.executable,
        "worker_extra_args": ["--lifetime", f"{life}s"],
        "job_script_prologue": list(table.setup),
        "job_extra_directives": [*_gpu_directives(file), *(_without_prefix(line, file.kind) for line in table.extra)],
        "log_directory": None if folder is None else str(folder),
        "interface": file.interface,
    }
    if isinstance(table, SlurmTable):
        return options | {"walltime": file.time, "queue": table.partition, "account": table.account}
    if isinstance(table, CondorTable):
        directives = dict(line.split("=", 1) if "=" in line else (line, "True") for line in options["job_extra_directives"])
        directives = {key.strip(): value.strip() for key, value in directives.items()}
        account = {"accounting_group": table.account} if table.account else {}
        limit = {"periodic_remove": f"(JobStatus == 2) && (time() - EnteredCurrentStatus > {seconds})"}
        return options | {"disk": f"{memory_bytes(table.disk)} B", "job_extra_directives": limit | account | directives}
    assert isinstance(table, QueueTable)
    options |= {"queue": table.queue, "account" if file.kind == "dask-pbs" else "project": table.account}
    hours, minutes = divmod(seconds // 60, 60)
    if file.kind == "dask-lsf":
        return options | {"walltime": f"{hours}:{minutes:02d}"}
    if file.kind == "dask-pbs":
        gpu = f":ngpus={file.gpus}" if file.gpus else ""
        options["resource_spec"] = f"select=1:ncpus={options['cores']}:mem={pbs_format_bytes_ceil(memory)}{gpu}"
    return options | {"walltime": f"{hours:02d}:{minutes:02d}:{seconds % 60:02d}"}


def _gpu_directives(file: ClusterFile) -> list[str]:
    """Return the lines that ask for a GPU, where they are the same on all sites. PBS is asked in its list of resources, SGE by the user."""
    lines = {"dask-slurm": "--gres=gpu:1", "dask-lsf": '-gpu "num=1"', "dask-htcondor": "request_gpus = 1"}
    return [lines[file.kind]] if file.gpus and file.kind in lines else []


def _without_prefix(line: str, kind: str) -> str:
    return line.removeprefix(PREFIXES.get(kind, "")).strip()


class Refusal(NamedTuple):
    """A job that was not accepted: the name of its worker, and what the batch system said."""

    name: str
    text: str


def _recording(kind: type[Job], accepted: set[str], refusals: list[Refusal]) -> type[Job]:
    """Return the class of a job that notes what became of its submission. An exception would end in a log that nobody reads."""

    class RecordedJob(kind):
        async def start(self) -> None:
            try:
                await super().start()
                accepted.add(str(self.name))
            except (RuntimeError, ValueError, OSError) as error:
                refusals.append(Refusal(str(self.name), _words(str(error))))
                # A job without a number: there is nothing to cancel.
                await super(Job, self).start()

        async def close(self) -> None:
            await super().close()
            await super(Job, self).close()

    RecordedJob.__name__ = kind.__name__
    return RecordedJob


def _words(text: str) -> str:
    """Return what a command of the batch system complained about, without the words of dask-jobqueue."""
    complaint = text.partition("stderr:\n")[2] or text
    return "; ".join(line.strip() for line in complaint.splitlines() if line.strip()) or text.strip()


class BatchJobs:
    """The jobs of a study.

    Args:
        file: the cluster.
        path: of its file, for sentences.
        out: the folder of the study.
        security: certificates for the workers.
        show: receives lines for the user.

    Raises:
        InputError: this machine has no batch system, or no such network interface.
    """

    def __init__(self, file: ClusterFile, path: str, out: Path, security: Security, show: Show):
        cluster = CLUSTERS[file.kind]
        command = cluster.job_cls.submit_command.split()[0]
        if which(command) is None:
            remedy = "run the study where you submit jobs, such as a login node"
            raise input_error(f"{path}: kind = {file.kind}", f"there is no `{command}` on this machine", "a machine that submits jobs", remedy)
        self._path, self._command, self._show = path, command, show
        self._folder = make_folder(out / FOLDER / "jobs")
        # Certificates of the workers, for this user alone.
        self._keys = Path(mkdtemp(prefix="keys-", dir=self._folder))
        self._accepted: set[str] = set()
        self._refusals: list[Refusal] = []
        self._most, self._refused = file.at_once or MOST_JOBS, 0
        self._next, self._begun, self._is_silent = 0.0, time.monotonic(), True
        try:
            self.cluster = cluster(
                job_cls=_recording(cluster.job_cls, self._accepted, self._refusals),
                security=security,
                shared_temp_directory=str(self._keys),
                scheduler_options={"dashboard_address": "localhost:0", "dashboard": False},
                silence_logs=False,
                **_options(file, self._folder),
            )
        except (ValueError, OSError, RuntimeError) as error:
            remedy = "correct `interface`, or leave it out" if file.interface else "see the words in parentheses"
            raise input_error(path, f"the study's scheduler cannot begin ({error})", "a network that the workers reach", remedy) from None

    def expect(self, units: int, workers: set[str], busy: set[str]) -> None:
        """Submit as many jobs as there are units, and cancel those that have nothing to do.

        Raises:
            InputError: all jobs are refused, or all that were submitted since the last worker has gone.
        """
        self._refused = 0 if workers else self._refused
        self._take_refusals()
        desired, specified = min(units, self._most), set(map(str, self.cluster.worker_spec))
        if len(specified) > desired:
            # Those that wait in the queue first.
            spare = sorted(specified - busy, key=lambda name: name in workers)[: len(specified) - desired]
            self.cluster.sync(self.cluster.scale_down, spare)
        elif time.monotonic() >= self._next:
            # Jobs whose time is over are submitted again, too.
            self._next = time.monotonic() + AGAIN_S
            self.cluster.scale(jobs=desired)
        self._remark(bool(workers))

    def close(self) -> None:
        """Cancel all jobs, and end the scheduler."""
        # Workers without a scheduler end by themselves.
        with suppress(Exception):
            self.cluster.close(timeout=30)
        rmtree(self._keys, ignore_errors=True)

    def _take_refusals(self) -> None:
        if not self._refusals:
            return
        refusals = [self._refusals.pop() for _ in range(len(self._refusals))]
        text = refusals[0].text
        self._refused += 1
        if not self._accepted or self._refused >= MOST_REFUSALS:
            remedy = "correct the file; `bayes-body study ... --dry-run` prints the job script"
            raise input_error(self._path, f"{self._command} refuses the job: {text}", "a job that the batch system accepts", remedy)
        self.cluster.sync(self.cluster.scale_down, [refusal.name for refusal in refusals])
        self._most = max(1, len(self.cluster.worker_spec))
        self._show(f"note: {self._command} accepts no more than {self._most} jobs: {text}")

    def _remark(self, is_there: bool) -> None:
        """Say once that no worker has come."""
        self._is_silent = self._is_silent and not is_there
        if self._is_silent and time.monotonic() - self._begun > SILENT_S:
            self._is_silent = False
            jobs = len(self.cluster.worker_spec)
            self._show(f"note: {jobs} jobs were submitted, and no worker has come yet; what ended jobs have printed is in {self._folder}.")
