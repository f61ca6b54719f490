"""A file in the folder of a study by which the workers of a cluster are tested: whether they see the same disk, and whether locks hold there."""

import secrets
from contextlib import suppress
from pathlib import Path

from filelock import FileLock

from bayes_body.base.errors import input_error
from bayes_body.base.files.atomic import make_folder, refused
from bayes_body.runs.study.records import FOLDER
from bayes_body.runs.study.worker import Inspection


class DriverFile:
    """A file with a token, and a lock beside it that is held until `close`.

    Args:
        out: the folder of the study.
        version: of this bayes_body.

    Raises:
        InputError: the file system refuses it.
    """

    def __init__(self, out: Path, version: str):
        self.token, self._out, self._version = secrets.token_hex(6), out, version
        self.path = make_folder(out / FOLDER) / f"driver-{self.token}"
        self._lock = FileLock(f"{self.path}.lock", timeout=0, is_singleton=False)
        try:
            self._lock.acquire()
            self.path.write_text(self.token, encoding="utf-8")
        except (OSError, NotImplementedError) as error:
            raise refused(self.path, "written and locked", OSError(str(error))) from None

    def close(self) -> None:
        """Remove both files."""
        self._lock.release()
        for path in (self.path, Path(f"{self.path}.lock")):
            with suppress(OSError):
                path.unlink(missing_ok=True)

    def may_change(self, reply: Inspection | Exception) -> bool:
        """Whether a worker that has a fault may have none some seconds later: it did not answer, or its disk does not show the file yet."""
        return isinstance(reply, OSError) if isinstance(reply, Exception) else not reply.token

    def fault(self, address: str, reply: Inspection | Exception, gpus: int = 0) -> str | None:
        """Return why a worker cannot compute units that need so many GPUs, as a sentence; None if it can."""
        if isinstance(reply, OSError):
            return str(input_error(f"worker {address}", f"does not answer ({reply})", "a worker that can be reached", "start it again"))
        if not isinstance(reply, Inspection):
            remedy = f"install bayes-body {self._version} with the extra `cluster` for the Python of the worker"
            return str(input_error(f"worker {address}", f"cannot load bayes_body ({reply})", f"bayes-body {self._version}", remedy))
        subject = f"worker {reply.name} on {reply.host}"
        if reply.version != self._version:
            remedy = "install the same version there"
            return str(input_error(subject, f"bayes-body {reply.version}", f"bayes-body {self._version}, as here", remedy))
        if reply.token != self.token:
            remedy = "name a folder with --out that all machines see under one path"
            return str(input_error(subject, f"does not see {self._out}", "the folder of the study, on a disk that all machines share", remedy))
        if reply.lock not in ("seen", "free"):
            remedy = "mount the disk with locks (Lustre: `-o flock`), or name a folder on another disk with --out"
            return str(input_error(subject, f"cannot lock files in {self._out} ({reply.lock})", "a disk with locks", remedy))
        if reply.gpus < gpus:
            remedy = "install bayes-body[cuda] there, or give gpus = 0"
            return str(input_error(subject, "no GPU that JAX could use", "one, since the study asks for it", remedy))
        return None

    def remark(self, reply: Inspection) -> str:
        """Return what a user must know about the disk of a worker that can compute; empty if there is nothing."""
        if reply.lock == "seen":
            return ""
        return (
            f"{reply.host} does not see locks that this machine holds in {self._out}: do not start the study twice at once, and wait a minute before "
            "you start it again after it was killed."
        )
