"""The workers of a Dask cluster that can compute units of a study. Each is inspected before it gets one."""

import time
from typing import Any, NamedTuple

from distributed import Client

from bayes_body.base.errors import InputError, input_error
from bayes_body.runs.study.driver import Show
from bayes_body.runs.study.driver_file import DriverFile
from bayes_body.runs.study.worker import Inspection, inspect_worker

# Seconds between looks at the workers, without an answer of the scheduler until it counts as gone, and for an answer of a worker.
LOOK_S, LOST_S, ANSWER_S = 1.0, 30.0, 20.0
# A network disk shows a new file some seconds later on other machines (30 by default of NFS). A worker that cannot compute is asked again later.
SHOWN_S, SOON_S, LATER_S = 40.0, 2.0, 60.0


class Worker(NamedTuple):
    """A worker that can compute units.

    Attributes:
        inspection: what it says about itself.
        threads: its number of threads.
    """

    inspection: Inspection
    threads: int


class Stranger(NamedTuple):
    """A worker that has not said yet that it can compute.

    Attributes:
        since: when it came.
        due: when it is asked next.
        sentence: why it cannot; empty as long as that is not certain.
    """

    since: float
    due: float
    sentence: str = ""


class DaskWorkers:
    """The workers of a scheduler.

    Args:
        client: is connected to the scheduler.
        address: of the scheduler, for sentences.
        file: by which a worker is tested for the disk of the study.
        gpus: number of GPUs that a unit needs.
        show: receives lines for the user.

    Attributes:
        able: those that can compute units, by their address.
        is_lost: whether the scheduler has gone.
    """

    def __init__(self, client: Client, address: str, file: DriverFile, gpus: int, show: Show):
        self._client, self._address, self._file, self._gpus, self._show = client, address, file, gpus, show
        self.able: dict[str, Worker] = {}
        self.is_lost = False
        self._strangers: dict[str, Stranger] = {}
        self._noted: set[str] = set()
        self._next_look, self._answered, self._has_computed = 0.0, time.monotonic(), False

    @property
    def names(self) -> set[str]:
        """The names of those that can compute units."""
        return {worker.inspection.name for worker in self.able.values()}

    def require_gpus(self, gpus: int) -> None:
        """Let units need another number of GPUs from now on."""
        self._gpus = gpus

    def wait(self) -> None:
        """Look until one can compute units, or none of those that are there can.

        Raises:
            InputError: none of those that are there can; or the scheduler has gone.
        """
        self._next_look = 0.0
        self.look()
        while not self.able and any(not stranger.sentence for stranger in self._strangers.values()):
            time.sleep(SOON_S / 4)
            self.look()
        self.check()

    def look(self) -> None:
        """Learn which workers there are.

        Raises:
            InputError: the scheduler has gone.
        """
        if time.monotonic() < self._next_look:
            return
        try:
            threads: Any = self._client.nthreads(callback_timeout=LOST_S / 3)
        except Exception:
            if time.monotonic() - self._answered > LOST_S:
                self.is_lost = True
                remedy = "start the cluster again and repeat the command, which goes on after the last frames"
                raise input_error(self._address, "its scheduler has gone", "the scheduler of a Dask cluster", remedy) from None
            self._next_look = time.monotonic() + LOOK_S
            return
        self._answered = time.monotonic()
        time_s = self._answered
        self.able = {address: worker for address, worker in self.able.items() if address in threads}
        self._strangers = {address: self._strangers.get(address, Stranger(time_s, time_s)) for address in threads if address not in self.able}
        due = [address for address, stranger in self._strangers.items() if stranger.due <= time_s]
        if due:
            self._inspect(due, threads)
        self._next_look = time.monotonic() + LOOK_S

    def _inspect(self, addresses: list[str], threads: dict[str, int]) -> None:
        try:
            replies: Any = self._client.run(inspect_worker, str(self._file.path), workers=addresses, on_error="return", callback_timeout=ANSWER_S)
        except Exception as error:
            # One of them has gone meanwhile, or does not answer.
            replies = dict.fromkeys(addresses, error)
        for address in addresses:
            reply, stranger = replies.get(address, TimeoutError("no answer")), self._strangers[address]
            sentence = self._file.fault(address, reply, self._gpus)
            if sentence is None:
                self.able[address], self._has_computed = Worker(reply, threads[address]), True
                del self._strangers[address]
                self._note(self._file.remark(reply))
            elif self._file.may_change(reply) and time.monotonic() - stranger.since < SHOWN_S:
                self._strangers[address] = stranger._replace(due=time.monotonic() + SOON_S)
            else:
                self._strangers[address] = stranger._replace(due=time.monotonic() + LATER_S, sentence=sentence)
                self._note(sentence)

    def check(self) -> None:
        """Refuse to wait for workers if all that have ever come cannot compute units.

        Raises:
            InputError: so it is.
        """
        sentences = [stranger.sentence for stranger in self._strangers.values()]
        if sentences and all(sentences) and not self._has_computed:
            raise InputError(min(sentences))

    def _note(self, sentence: str) -> None:
        if sentence and sentence not in self._noted:
            self._noted.add(sentence)
            self._show(f"note: {sentence}")
