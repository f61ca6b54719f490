"""What a unit says about itself on the shared disk: its state as JSON, its output, and a lock that ends with its process.

Whoever computes a unit holds its lock and writes its state. A state "running" without a lock is that of a process that was killed.
"""

import json
import os
import secrets
from contextlib import suppress
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

from filelock import FileLock, Timeout

from bayes_body.base.files.atomic import make_folder, refused

FOLDER = ".study"
STOPPED = "stopped"
# The end of a unit's output, in which its last sentence is looked for.
LAST_BYTES = 20_000


@dataclass(frozen=True)
class Record:
    """The state of a unit.

    Attributes:
        state: running, done, failed or stopped.
        digest: `Unit.digest` of what it is about.
        work: `Unit.work` of what it is about.
        host: name of the machine that computed last.
        process: number of the process there.
        begun: when it began last, seconds since 1970.
        seconds: of work, over all processes.
        frames: number of stored frames when a process began last.
        deaths: how many processes ended without a new frame, one after the other.
        sentence: why it failed; empty otherwise.
        peak_bytes: largest memory of a process.
        cache_hits: programs that came from the cache of compiled programs.
        cache_misses: programs that were compiled.
    """

    state: str
    digest: str
    work: str
    host: str = ""
    process: int = 0
    begun: float = 0.0
    seconds: float = 0.0
    frames: int = 0
    deaths: int = 0
    sentence: str = ""
    peak_bytes: int = 0
    cache_hits: int = 0
    cache_misses: int = 0


class UnitFiles:
    """The files of a unit in the folder of a study.

    Args:
        out: the folder of the study.
        session: the session's name.
        name: the unit's name within it.
    """

    def __init__(self, out: Path, session: str, name: str):
        self._folder, self._name = out / FOLDER / session, name

    @property
    def log(self) -> Path:
        """The file of what its commands printed."""
        return self._folder / f"{self._name}.log"

    @property
    def picture(self) -> Path:
        """A small picture of its run."""
        return self._folder / f"{self._name}.jpg"

    @property
    def lock(self) -> FileLock:
        """A lock that the process holds while it computes."""
        return FileLock(self._folder / f"{self._name}.lock", timeout=0, is_singleton=False)

    def is_locked(self) -> bool:
        """Whether a process computes the unit now."""
        lock = self.lock
        if not Path(lock.lock_file).exists():
            return False
        try:
            lock.acquire()
        except Timeout:
            return True
        except OSError:
            return False
        lock.release()
        return False

    def read(self) -> Record | None:
        """Return its state; None if there is none, or none that can be read."""
        try:
            table: dict[str, Any] = json.loads((self._folder / f"{self._name}.json").read_bytes())
            return Record(**{field.name: table[field.name] for field in fields(Record)})
        except (OSError, ValueError, KeyError, TypeError):
            return None

    def write(self, record: Record) -> None:
        """Replace its state. It does not wait for the disk: a state that a power cut destroys counts as none, and the run itself tells the rest.

        Raises:
            InputError: the file system refuses it.
        """
        path = make_folder(self._folder) / f"{self._name}.json"
        partial = path.with_name(f".{self._name}-{secrets.token_hex(4)}")
        try:
            partial.write_text(json.dumps(asdict(record)), encoding="utf-8")
            partial.replace(path)
        except OSError as error:
            with suppress(OSError):
                partial.unlink(missing_ok=True)
            raise refused(path, "written", error) from None


def last_complaint(log: Path, begin: int = 0) -> str:
    """Return the last sentence that a command of bayes-body wrote to standard error; empty if there is none.

    Args:
        log: the file.
        begin: where it begins to count, bytes.
    """
    try:
        with log.open("rb") as file:
            file.seek(max(begin, os.fstat(file.fileno()).st_size - LAST_BYTES))
            lines = file.read().decode("utf-8", "replace").splitlines()
    except OSError:
        return ""
    complaints = [line.removeprefix("bayes-body: ") for line in lines if line.startswith("bayes-body: ")]
    complaints = [line for line in complaints if not line.startswith("note:")]
    return complaints[-1] if complaints else ""
