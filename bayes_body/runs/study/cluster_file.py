"""A cluster in writing, as the option `--cluster lab.toml` reads it: a batch system that starts the workers as jobs, or machines by ssh."""

import re
from pathlib import Path
from typing import Annotated, Literal, Self

from pydantic import AfterValidator, Field, model_validator

from bayes_body.base.toml.read import read_toml, validate
from bayes_body.base.toml.schema import Count, Name, Schema

# The table of each batch system, by the file's kind.
TABLES = {"dask-slurm": "slurm", "dask-pbs": "pbs", "dask-lsf": "lsf", "dask-sge": "sge", "dask-htcondor": "htcondor"}
SSH = "ssh"
FACTORS = {"K": 10**3, "M": 10**6, "G": 10**9, "T": 10**12, "KI": 2**10, "MI": 2**20, "GI": 2**30, "TI": 2**40}
MEMORY = re.compile(r"(\d+(?:\.\d+)?)\s*([KMGT]I?)B?", re.IGNORECASE)
TIME = re.compile(r"(?:(\d+)-)?(\d{1,3}):([0-5]\d):([0-5]\d)")
# A unit alone needs about a gigabyte.
LEAST_BYTES, LEAST_S = 100 * 10**6, 60


def memory_bytes(text: str) -> int:
    """Return the number of bytes that a text such as `4 GB` or `4GiB` says.

    Raises:
        ValueError: it says none.
    """
    match = MEMORY.fullmatch(text.strip())
    size = round(float(match[1]) * FACTORS[match[2].upper()]) if match else 0
    if size < LEAST_BYTES:
        raise ValueError(f'"{text}"; expected the memory of a unit, 100 MB or more, such as "4 GB" or "4 GiB"; correct the number or its unit')
    return size


def time_seconds(text: str) -> int:
    """Return the number of seconds that a text such as `2:00:00` or `1-12:00:00` (days, hours, minutes, seconds) says.

    Raises:
        ValueError: it says none.
    """
    match = TIME.fullmatch(text.strip())
    days, hours, minutes, seconds = (int(part or 0) for part in match.groups()) if match else (0, 0, 0, 0)
    total = ((days * 24 + hours) * 60 + minutes) * 60 + seconds
    if total < LEAST_S:
        raise ValueError(
            f'"{text}"; expected hours:minutes:seconds, one minute or more, such as "2:00:00", or "1-12:00:00" with days; write all three numbers'
        )
    return total


def _checked_memory(text: str) -> str:
    memory_bytes(text)
    return text


def _checked_time(text: str) -> str:
    time_seconds(text)
    return text


class BatchTable(Schema):
    """What a batch system needs to know."""

    account: Name | None = None
    """Account or project that pays"""
    extra: list[Name] = []
    """Further directives, such as `"--qos=long"`, without `#SBATCH` before them"""
    setup: list[Name] = []
    """Shell lines before the worker, such as `"module load cuda"` or `"source venv/bin/activate"`"""


class SlurmTable(BatchTable):
    """`[slurm]`."""

    partition: Name | None = None
    """Partition; the default one of the system if none is named"""


class QueueTable(BatchTable):
    """`[pbs]`, `[lsf]`, `[sge]`."""

    queue: Name | None = None
    """Queue; the default one of the system if none is named"""


class CondorTable(BatchTable):
    """`[htcondor]`."""

    disk: Annotated[str, AfterValidator(_checked_memory)] = "1 GB"
    """Disk of a job"""


class SSHTable(Schema):
    """`[ssh]`."""

    hosts: Annotated[list[Name], Field(min_length=1)]
    """Machines, as the program `ssh` knows them"""
    user: Name | None = None
    """User there; that of ssh's own settings by default"""
    port: Annotated[int, Field(strict=True, ge=1, le=65535)] | None = None
    """Port of ssh there; that of ssh's own settings by default"""
    python: Name | None = None
    """Python there, with bayes-body and its extra `cluster`; by default the path of the one that runs the study"""


class ClusterFile(Schema):
    """The whole file."""

    kind: Literal["dask-slurm", "dask-pbs", "dask-lsf", "dask-sge", "dask-htcondor", "ssh"]
    """What starts the workers"""
    cpus: Count | None = None
    """Cores of a unit; one by default"""
    memory: Annotated[Name, AfterValidator(_checked_memory)] | None = None
    """Memory of a unit, such as `"4 GB"`; a batch system requires it"""
    gpus: Annotated[int, Field(strict=True, ge=0, le=1)] | None = None
    """GPUs of a unit, 0 or 1; 0 by default, and by ssh 1 where all machines have one"""
    time: Annotated[Name, AfterValidator(_checked_time)] | None = None
    """Longest time of a job, such as `"2:00:00"` or `"1-12:00:00"`; a batch system requires it. Units of several hours go on in the next job"""
    at_once: Count | None = None
    """Most jobs (ssh: units) at once; 50 jobs by default"""
    retries: Count | None = None
    """How often a unit may die without a new frame before it counts as failed; by default as the study says"""
    interface: Name | None = None
    """Network interface over which the workers reach the machine of the study, such as `"ib0"`"""
    slurm: SlurmTable = SlurmTable()
    """Of `dask-slurm`"""
    pbs: QueueTable = QueueTable()
    """Of `dask-pbs`"""
    lsf: QueueTable = QueueTable()
    """Of `dask-lsf`"""
    sge: QueueTable = QueueTable()
    """Of `dask-sge`"""
    htcondor: CondorTable = CondorTable()
    """Of `dask-htcondor`"""
    ssh: SSHTable | None = None
    """Of `ssh`"""

    @property
    def batch(self) -> BatchTable:
        """The table of its batch system."""
        return getattr(self, TABLES[self.kind])

    @model_validator(mode="after")
    def _check(self) -> Self:
        wanted = TABLES.get(self.kind, SSH)
        faults = [
            f"[{table}]: a table of another kind than {self.kind}; expected [{wanted}]; remove it, or correct `kind`"
            for table in (*TABLES.values(), SSH)
            if table in self.model_fields_set and table != wanted
        ]
        if self.kind == SSH and self.ssh is None:
            faults.append('[ssh]: missing; expected the machines; add it, with a line hosts = ["name", "name"]')
        if self.kind != SSH:
            examples = (("memory", "4 GB"), ("time", "2:00:00"))
            faults += [
                f'{key}: missing; expected what a job of one unit may use; add {key} = "{text}"' for key, text in examples if not getattr(self, key)
            ]
        if self.kind == "dask-sge" and self.gpus and not self.sge.extra:
            faults.append(
                'sge.extra: missing; expected the directive for a GPU, which differs from site to site; add it, such as extra = ["-l gpu=1"]'
            )
        if faults:
            raise ValueError("\n".join(faults))
        return self


def read_cluster_file(path: Path) -> ClusterFile:
    """Return a cluster from its file.

    Raises:
        InputError: the file cannot be read, or is not TOML.
        FaultyFileError: it has faults; one sentence for each.
    """
    return validate(ClusterFile, read_toml(path), str(path))
