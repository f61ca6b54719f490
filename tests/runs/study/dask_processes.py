"""Schedulers and workers of Dask as processes of this machine, and programs that stand for those of a batch system and of ssh."""

import json
import os
import signal
import stat
import subprocess
import sys
import time
from contextlib import contextmanager, suppress
from pathlib import Path

from distributed import Client

from bayes_body.runs.study.study_file import StudyFile

STUB = (str(Path(__file__).with_name("stub_unit.py")),)
WAIT_S = 120

# Like sbatch: it keeps the script, runs it in the background, and says its number.
SBATCH = """#!{python}
import subprocess, sys, uuid
from pathlib import Path
jobs = Path({folder!r})
# Two jobs may be submitted at once: a number belongs to whoever makes its file.
for number in range(1, {most} + 1):
    script = jobs / f"{{number}}.sh"
    try:
        with script.open("x") as file:
            file.write(Path(sys.argv[1]).read_text())
        break
    except FileExistsError:
        pass
else:
    print("sbatch: error: invalid partition specified: nosuch", file=sys.stderr)
    sys.exit(1)
with (jobs / f"{{number}}.log").open("w") as log:
    process = subprocess.Popen(["bash", str(script)], stdin=subprocess.DEVNULL, stdout=log, stderr=log, start_new_session=True)
(jobs / f"{{number}}.pid").write_text(str(process.pid))
print(f"Submitted batch job {{number}}")
"""
SCANCEL = """#!{python}
import os, signal, sys
from pathlib import Path
jobs = Path({folder!r})
(jobs / f"{{sys.argv[1]}}.cancelled").touch()
try:
    os.killpg(int((jobs / f"{{sys.argv[1]}}.pid").read_text()), signal.SIGTERM)
except ProcessLookupError:
    sys.exit(1)
"""
# Like ssh: the shell of the machine runs the last word.
SSH = """#!{python}
import os, sys
from pathlib import Path
*options, host, command = sys.argv[1:]
with (Path({folder!r}) / "ssh.txt").open("a") as file:
    file.write(" ".join([*options, host]) + "\\n")
if host == "nowhere":
    print("ssh: Could not resolve hostname nowhere", file=sys.stderr)
    sys.exit(255)
os.execvp("sh", ["sh", "-c", command])
"""


def study_of(folder, names, **keys):
    """A study of sessions without cameras, which only the stub can track. A session's name is also what the stub does with it."""
    for name in names:
        (folder / name).mkdir(parents=True, exist_ok=True)
        (folder / name / "session.toml").write_text("frames = 3\n")
        (folder / name / name.partition("_")[0]).touch()
    return StudyFile(sessions=[str(folder / name) for name in names], steps=[], **keys)


def program(path, text, **values):
    """Write an executable."""
    path.parent.mkdir(exist_ok=True)
    path.write_text(text.format(python=sys.executable, **values))
    path.chmod(path.stat().st_mode | stat.S_IXUSR)


def is_alive(process):
    """Whether a process computes still; one that nobody has waited for is dead."""
    with suppress(OSError):
        return Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    return False


def wait_until(condition, words):
    deadline = time.monotonic() + WAIT_S
    while not condition():
        assert time.monotonic() < deadline, words
        time.sleep(0.05)


class DaskProcesses:
    """A scheduler and workers, each a process."""

    def __init__(self, folder):
        self.folder, self.file = folder, folder / "scheduler.json"
        self._processes = []

    def begin(self):
        options = ["--scheduler-file", str(self.file), "--host", "127.0.0.1", "--port", "0", "--no-dashboard"]
        self.scheduler = self._start("scheduler", *options)
        # The file is there before its content is.
        wait_until(lambda: self.file.exists() and self.file.read_text().endswith("}"), "the scheduler has not begun")
        self.address = json.loads(self.file.read_text())["address"]

    def worker(self, *options):
        return self._start("worker", self.address, "--nthreads", "1", "--no-dashboard", "--death-timeout", "10", *options)

    def wait_for(self, workers):
        with Client(self.address, set_as_default=False) as client:
            client.wait_for_workers(workers, timeout=WAIT_S)

    def close(self):
        for process in self._processes:
            with suppress(OSError):
                os.killpg(process.pid, signal.SIGKILL)
            process.wait()

    def _start(self, kind, *arguments):
        log = (self.folder / f"{kind}_{len(self._processes)}.log").open("w")
        with log:
            command = [sys.executable, "-m", f"distributed.cli.dask_{kind}", *arguments]
            process = subprocess.Popen(command, stdout=log, stderr=subprocess.STDOUT, cwd=self.folder, start_new_session=True)
        self._processes.append(process)
        return process


@contextmanager
def dask_processes(folder):
    folder.mkdir(parents=True, exist_ok=True)
    processes = DaskProcesses(folder)
    try:
        processes.begin()
        yield processes
    finally:
        processes.close()
