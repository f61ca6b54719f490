"""Workers on machines by ssh: the program `ssh` starts one on each, with the user's own keys and settings. They end with the study's scheduler."""

import os
import shlex
import subprocess
import sys
import threading
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from shutil import which

from distributed import LocalCluster, Security

from bayes_body.base.errors import input_error
from bayes_body.base.files.atomic import make_folder, refused
from bayes_body.runs.study.cluster_file import ClusterFile, SSHTable
from bayes_body.runs.study.records import FOLDER

type Show = Callable[[str], None]

# ssh asks no questions, and gives up a machine that does not answer.
OPTIONS = ("-o", "BatchMode=yes", "-o", "ConnectTimeout=20", "-o", "ServerAliveInterval=30")
# Seconds after which a worker without a scheduler ends.
DEATH_S = 60


def ssh_command(file: ClusterFile, table: SSHTable, host: str, scheduler: str, certificates: list[str]) -> list[str]:
    """Return the command line that starts the worker of a machine.

    Args:
        file: the cluster.
        table: its table `[ssh]`.
        host: the machine.
        scheduler: address of the study's scheduler.
        certificates: options of the worker for encryption.
    """
    user = ("-l", table.user) if table.user else ()
    port = ("-p", str(table.port)) if table.port else ()
    interface = ("--interface", file.interface) if file.interface else ()
    python = (table.python or sys.executable, "-m", "distributed.cli.dask_worker")
    worker = (*python, scheduler, "--name", host, "--nworkers", "1", "--nanny", "--death-timeout", str(DEATH_S), "--no-dashboard")
    return ["ssh", *OPTIONS, *user, *port, "--", host, shlex.join([*worker, *interface, *certificates])]


class SSHWorkers:
    """The workers of a study.

    Args:
        file: the cluster.
        table: its table `[ssh]`.
        path: of its file, for sentences.
        out: the folder of the study.
        security: certificates of the scheduler and the workers.
        show: receives lines for the user.

    Raises:
        InputError: this machine has no ssh, or no such network interface, or the certificates cannot be written.
    """

    def __init__(self, file: ClusterFile, table: SSHTable, path: str, out: Path, security: Security, show: Show):
        if which("ssh") is None:
            raise input_error(f"{path}: kind = ssh", "there is no `ssh` on this machine", "the program ssh", "install it")
        self._path, self._show = path, show
        self._folder = make_folder(out / FOLDER)
        try:
            self.cluster = LocalCluster(
                n_workers=0,
                # All interfaces, unless one is named. 127.0.0.1 is the default of the class.
                host=None if file.interface else "tls://0.0.0.0",
                interface=file.interface,
                protocol="tls://",
                security=security,
                dashboard_address="localhost:0",
                silence_logs=False,
            )
        except (ValueError, OSError, RuntimeError) as error:
            remedy = "correct `interface`, or leave it out" if file.interface else "see the words in parentheses"
            raise input_error(path, f"the study's scheduler cannot begin ({error})", "a network that the machines reach", remedy) from None
        try:
            self._keys = _write_certificates(security, self._folder)
        except OSError as error:
            self.cluster.close()
            raise refused(self._folder, "written", error) from None
        options = [text for name, key in self._keys.items() for text in (f"--tls-{name.replace('_', '-')}", str(key))]
        self._processes = {host: _Process(ssh_command(file, table, host, self.cluster.scheduler_address, options)) for host in table.hosts}

    def expect(self, units: int, workers: set[str], busy: set[str]) -> None:
        """Say which workers have ended.

        Raises:
            InputError: all of them.
        """
        faults: list[str] = []
        for host in [host for host, process in self._processes.items() if process.has_ended()]:
            faults.append(f"{host}: {self._processes.pop(host).words()}")
        if faults and not self._processes and not workers:
            remedy = "correct `hosts`, `user`, `port` and `python`; `ssh HOST` must need no password"
            raise input_error(self._path, f"no worker by ssh: {'; '.join(faults)}", "machines where a worker can be started", remedy)
        for fault in faults:
            self._show(f"note: the worker on {fault}")

    def close(self) -> None:
        """End the scheduler, and with it all workers."""
        # Workers without a scheduler end by themselves.
        with suppress(Exception):
            self.cluster.close(timeout=10)
        for process in self._processes.values():
            process.end()
        for path in self._keys.values():
            with suppress(OSError):
                path.unlink(missing_ok=True)


def _write_certificates(security: Security, folder: Path) -> dict[str, Path]:
    """Write what a worker needs to encrypt, for this user alone."""
    paths = {}
    for name, text in security.get_tls_config_for_role("worker").items():
        if text is None or "\n" not in text:
            continue
        path = folder / f"worker-{os.getpid()}-{name}.pem"
        path.unlink(missing_ok=True)
        with os.fdopen(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "w") as file:
            file.write(text)
        paths[name] = path
    return paths


class _Process:
    """The process of ssh that starts a worker, and the last lines that it has printed."""

    def __init__(self, command: list[str]):
        # In a process group of its own: Ctrl-C reaches the study only, which ends its units in order.
        self._process = subprocess.Popen(
            command, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, errors="replace", start_new_session=True
        )
        self._lines: deque[str] = deque(maxlen=20)
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    def has_ended(self) -> bool:
        """Whether the worker has ended."""
        return self._process.poll() is not None

    def words(self) -> str:
        """Return why, in the words of ssh or of the machine."""
        self._reader.join(timeout=1)
        return self._lines[-1] if self._lines else f"ended with status {self._process.returncode}"

    def end(self) -> None:
        """End it, if it has not ended by itself."""
        with suppress(subprocess.TimeoutExpired):
            self._process.wait(5)
            return
        self._process.terminate()
        with suppress(subprocess.TimeoutExpired):
            self._process.wait(5)
            return
        self._process.kill()

    def _read(self) -> None:
        assert self._process.stdout is not None
        with self._process.stdout as stream:
            self._lines.extend(line.strip() for line in stream if line.strip())
