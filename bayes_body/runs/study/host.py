"""Cores and GPUs of this machine, shared by all units on it, whoever started them. Each is a lock in the machine's folder for temporary files."""

import os
import shutil
import subprocess
import tempfile
from collections.abc import Sequence
from contextlib import suppress
from importlib.util import find_spec
from pathlib import Path

from filelock import FileLock, Timeout

# Where Linux says how much memory there is, and how much a container may have and has.
MEMORY, CONTAINER = Path("/proc/meminfo"), Path("/sys/fs/cgroup")
CUDA_PLUGINS = ("jax_cuda12_plugin", "jax_cuda13_plugin")


class HostShare:
    """Cores or GPUs that this process has taken. The operating system frees them when the process ends."""

    def __init__(self) -> None:
        self._locks: list[FileLock] = []

    def take(self, kind: str, numbers: Sequence[str], count: int) -> list[str]:
        """Return `count` of these numbers that no other process has taken; none if there are not so many.

        Args:
            kind: core or gpu.
            numbers: those that this process may use.
            count: how many it needs.
        """
        folder = _lock_folder()
        if folder is None:
            return []
        taken: dict[str, FileLock] = {}
        for number in numbers:
            lock = FileLock(folder / f"{kind}_{number}.lock", timeout=0, is_singleton=False)
            with suppress(Timeout, OSError):
                lock.acquire()
                taken[number] = lock
            if len(taken) == count:
                self._locks.extend(taken.values())
                return list(taken)
        for lock in taken.values():
            lock.release()
        return []


def _lock_folder() -> Path | None:
    """Return a folder on this machine that belongs to this user alone; None if there is none."""
    user = os.getuid() if hasattr(os, "getuid") else 0
    folder = Path(tempfile.gettempdir()) / f"bayes_body-{user}"
    try:
        folder.mkdir(mode=0o700, exist_ok=True)
        return folder if not folder.is_symlink() and folder.stat().st_uid == user else None
    except OSError:
        return None


def cores() -> list[int]:
    """Return the cores that this process may use."""
    return sorted(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else list(range(os.cpu_count() or 1))


def gpus() -> list[str]:
    """Return the GPUs that JAX would use, as CUDA_VISIBLE_DEVICES names them. Nothing is loaded, and no GPU is touched."""
    if os.environ.get("JAX_PLATFORMS", "cuda").split(",")[0] not in ("cuda", "gpu") or not any(map(find_spec, CUDA_PLUGINS)):
        return []
    visible = os.environ.get("CUDA_VISIBLE_DEVICES")
    if visible is not None:
        return [name.strip() for name in visible.split(",") if name.strip() not in ("", "-1")]
    return [str(number) for number, _ in enumerate(_listed_gpus())]


def gpu_identities(names: Sequence[str]) -> dict[str, str]:
    """Return the names that `gpus` returned, by a name that means the same to all processes of the machine.

    A batch system may show each job only its own GPU, which is then number 0 for all of them.
    """
    listed = dict(enumerate(_listed_gpus()))
    return {listed.get(int(name), name) if name.isdecimal() else name: name for name in names}


def _listed_gpus() -> list[str]:
    """Return the UUIDs of the GPUs that this process may see, in their order."""
    if shutil.which("nvidia-smi") is None:
        return []
    try:
        listed = subprocess.run(["nvidia-smi", "-L"], capture_output=True, text=True, timeout=20, check=True).stdout
    except (OSError, subprocess.SubprocessError):
        return []
    return [line.rpartition("UUID: ")[2].strip(" )") for line in listed.splitlines() if line.startswith("GPU ")]


def free_bytes() -> int | None:
    """Return the memory that new processes can have, bytes; None where the system does not say."""
    amounts = []
    with suppress(OSError, ValueError, IndexError):
        line = next(line for line in MEMORY.read_text().splitlines() if line.startswith("MemAvailable"))
        amounts.append(int(line.split()[1]) * 1024)
    with suppress(OSError, ValueError):
        amounts.append(int((CONTAINER / "memory.max").read_text()) - int((CONTAINER / "memory.current").read_text()))
    return min(amounts, default=None)


def peak_bytes(process: int) -> int:
    """Return the largest memory that a running process has had, bytes; 0 where the system does not say."""
    try:
        lines = Path(f"/proc/{process}/status").read_text().splitlines()
        return next(int(line.split()[1]) * 1024 for line in lines if line.startswith("VmHWM"))
    except (OSError, ValueError, StopIteration):
        return 0
