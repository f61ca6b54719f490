"""Run the units of a study on a cluster: connect to a scheduler of Dask, or start one, with workers of a batch system or by ssh.

Dask says where and when; what a unit is, whether it is done and how often it has failed is known from the disk alone. The packages are an extra.
"""

import json
import logging
import shlex
import warnings
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING

from bayes_body.base.errors import input_error
from bayes_body.base.files.read import read_text
from bayes_body.runs.study.attempt import PROGRAM
from bayes_body.runs.study.cluster_file import SSH, ClusterFile, memory_bytes, read_cluster_file
from bayes_body.runs.study.driver import Share, Show
from bayes_body.runs.study.driver_file import DriverFile
from bayes_body.runs.study.study_file import StudyFile

if TYPE_CHECKING:
    from distributed import Client, Security

    from bayes_body.runs.study.batch_jobs import BatchJobs
    from bayes_body.runs.study.dask_places import DaskPlaces, Deployment
    from bayes_body.runs.study.ssh_workers import SSHWorkers

INSTALL = "install the extra: pip install 'bayes-body[cluster]'"
FORMS = "tcp://HOST:8786, a scheduler's file (.json), or a file that describes a cluster (.toml)"
# Seconds to reach a scheduler.
CONNECT_S = 20
# A scheduler's file has some hundred bytes.
LARGEST_BYTES = 1_000_000
LOGGERS = ("distributed", "dask_jobqueue", "tornado", "asyncio", "bokeh")


@contextmanager
def cluster_places(study: StudyFile, out: Path, show: Show, program: tuple[str, ...] = PROGRAM) -> Iterator[tuple["DaskPlaces", Share]]:
    """Yield the places of a study's cluster, and what a unit gets of them. At the end all workers that were started are ended.

    Args:
        study: the study; its key `cluster` is given.
        out: its folder.
        show: receives lines for the user.
        program: what Python executes for a unit.

    Raises:
        InputError: the extra is not installed, the cluster cannot be reached, or it cannot compute this study.
    """
    described = study.cluster or ""
    file = read_cluster_file(Path(described)) if described.endswith(".toml") else None
    address = "" if file else _address(described)
    _check_installed()
    from distributed import Security

    from bayes_body.runs.study.dask_places import DaskPlaces, RunningCluster

    cpus, gpus = (file.cpus if file else None) or study.cpus or 1, study.gpus if file is None or file.gpus is None else file.gpus
    share = Share(cpus, gpus or 0, (file.retries if file else None) or study.retries)
    limits = [limit for limit in (study.at_once, file.at_once if file else None) if limit is not None]
    with _quiet(), ExitStack() as stack:
        deployment: Deployment = RunningCluster()
        security = None
        if file is not None:
            # Whoever reaches a scheduler without certificates can run programs as its user.
            security = Security.temporary()
            deployment = _start(file, described, out, security, show)
            address = deployment.cluster.scheduler_address
        stack.callback(deployment.close)
        driver_file = DriverFile(out, version("bayes-body"))
        stack.callback(driver_file.close)
        client = _connect(address, security)
        name = described if file else address
        unit_bytes = memory_bytes(file.memory) if file and file.memory else 0
        places = DaskPlaces(client, name, deployment, driver_file, share, min(limits, default=None), unit_bytes, show, program)
        # From here on, the places close everything.
        stack.pop_all()
        try:
            inspections = places.inspect()
            if gpus is None and inspections and all(inspection.gpus for inspection in inspections):
                share = share._replace(gpus=1)
                places.assign(share)
            if not inspections:
                show(f"note: {name} has no workers yet; units begin as they come.")
            yield places, share
        finally:
            places.stop()


def job_script(study: StudyFile) -> str:
    """Return the script by which the batch system of a study starts a worker, or the commands by which ssh does. Nothing is submitted.

    Raises:
        InputError: the cluster's file cannot be used, or the extra is not installed.
    """
    described = study.cluster or ""
    if not described.endswith(".toml"):
        return f"cluster    {_address(described)}: a running Dask cluster; its workers are those that it has, no job is submitted"
    file = read_cluster_file(Path(described))
    _check_installed()
    if file.kind == SSH:
        from bayes_body.runs.study.ssh_workers import ssh_command

        assert file.ssh is not None
        return "\n".join(shlex.join(ssh_command(file, file.ssh, host, "tls://HOST-OF-THE-STUDY:PORT", [])) for host in file.ssh.hosts)
    from bayes_body.runs.study.batch_jobs import batch_job

    return batch_job(file).job_script()


def _address(described: str) -> str:
    """Return the address of a running scheduler.

    Raises:
        InputError: it is none, or the scheduler's file has none.
    """
    if "://" in described:
        return described
    if not described.endswith(".json"):
        raise input_error(f"--cluster: {Path(described).name}", "no cluster", FORMS, "correct it")
    text = read_text(Path(described), "a scheduler's file", LARGEST_BYTES)
    try:
        return str(json.loads(text)["address"])
    except (ValueError, KeyError, TypeError):
        remedy = "start `dask scheduler --scheduler-file FILE`, and name that file"
        raise input_error(described, "no address of a scheduler in it", "a file that a scheduler of Dask has written", remedy) from None


def _check_installed() -> None:
    """Refuse a cluster without the packages.

    Raises:
        InputError: one of them is not installed.
    """
    try:
        import cryptography as _cryptography
        import dask_jobqueue as _dask_jobqueue
        import distributed as _distributed
    except ImportError as error:
        raise input_error("--cluster", f"Dask is not installed ({error})", "the packages distributed and dask-jobqueue", INSTALL) from None
    del _cryptography, _dask_jobqueue, _distributed


def _start(file: ClusterFile, path: str, out: Path, security: "Security", show: Show) -> "BatchJobs | SSHWorkers":
    """Start a scheduler, and what starts its workers."""
    if file.kind == SSH:
        from bayes_body.runs.study.ssh_workers import SSHWorkers

        assert file.ssh is not None
        return SSHWorkers(file, file.ssh, path, out, security, show)
    from bayes_body.runs.study.batch_jobs import BatchJobs

    return BatchJobs(file, path, out, security, show)


def _connect(address: str, security: "Security | None") -> "Client":
    """Return a client of a scheduler.

    Raises:
        InputError: it cannot be reached.
    """
    from distributed import Client

    try:
        with warnings.catch_warnings():
            # Versions of Dask that differ: ours is compared with those of the workers.
            warnings.simplefilter("ignore")
            return Client(address, security=security, timeout=CONNECT_S, name="bayes-body", set_as_default=False)
    except (OSError, TimeoutError, ValueError, TypeError) as error:
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        remedy = "start one with `dask scheduler`, or correct the address; tls:// needs the certificates in Dask's own settings"
        raise input_error(
            f"--cluster {address}", f"cannot be reached within {CONNECT_S} s ({reason})", "the scheduler of a Dask cluster", remedy
        ) from None


@contextmanager
def _quiet() -> Iterator[None]:
    """Keep Dask's messages about workers that come and go from the terminal. What a user must know is said by the places."""
    names = [name for name in logging.root.manager.loggerDict if name.split(".")[0] in LOGGERS]
    loggers = [logging.getLogger(name) for name in {*names, *LOGGERS}]
    levels = [logger.level for logger in loggers]
    for logger in loggers:
        logger.setLevel(logging.CRITICAL + 1)
    try:
        yield
    finally:
        for logger, level in zip(loggers, levels, strict=True):
            logger.setLevel(level)
