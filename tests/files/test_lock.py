"""The lock of a run: one process at a time, and none that is gone."""

import os
import signal
import subprocess
import sys

import pytest

from bayes_body.errors import InputError
from bayes_body.files.lock import check_unlocked, locked

HOLD = """
import sys
from pathlib import Path
from bayes_body.files.lock import locked
with locked(Path(sys.argv[1])):
    print(1, flush=True)
    sys.stdin.read()
"""


@pytest.fixture
def holder(tmp_path):
    """A process that holds the folder's lock."""
    with subprocess.Popen([sys.executable, "-c", HOLD, str(tmp_path)], stdin=subprocess.PIPE, stdout=subprocess.PIPE) as process:
        process.stdout.readline()
        yield process
        process.kill()


def test_a_second_process_is_refused_and_told_which_one_works(tmp_path, holder):
    for entered in (lambda: locked(tmp_path).__enter__(), lambda: check_unlocked(tmp_path)):
        with pytest.raises(InputError, match=f"process {holder.pid} works on it; expected .*; wait for it, or name another folder"):
            entered()


def test_a_process_that_was_killed_holds_nothing(tmp_path, holder):
    holder.send_signal(signal.SIGKILL)
    holder.wait()
    with locked(tmp_path):
        assert (tmp_path / ".lock").read_text() == str(os.getpid())


def test_it_can_be_taken_again(tmp_path):
    for _ in range(2):
        with locked(tmp_path), pytest.raises(InputError, match="works on it"):
            check_unlocked(tmp_path)


def test_looking_makes_nothing(tmp_path):
    check_unlocked(tmp_path / "none")
    check_unlocked(tmp_path)
    assert not list(tmp_path.iterdir())
