"""The lock of a run: one process at a time, and none that is gone."""

import os
import signal
import subprocess
import sys

import pytest

from bayes_body.base.errors import InputError
from bayes_body.base.files.lock import locked

HOLD = """
import sys
from pathlib import Path
from bayes_body.base.files.lock import locked
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
    with pytest.raises(InputError, match=f"process {holder.pid} works on it; expected .*; wait for it, or name another folder"):
        locked(tmp_path).__enter__()


def test_a_process_that_was_killed_holds_nothing(tmp_path, holder):
    holder.send_signal(signal.SIGKILL)
    holder.wait()
    with locked(tmp_path):
        assert (tmp_path / ".lock").read_text() == str(os.getpid())


def test_it_can_be_taken_again(tmp_path):
    for _ in range(2):
        with locked(tmp_path), pytest.raises(InputError, match="works on it"):
            locked(tmp_path).__enter__()


def test_a_folder_that_was_made_for_nothing_is_removed_again(tmp_path):
    with pytest.raises(InputError, match="no"), locked(tmp_path / "new" / "run"):
        raise InputError("no")
    assert not list(tmp_path.iterdir())


def test_what_was_written_and_what_was_there_stays(tmp_path):
    (tmp_path / "empty").mkdir()

    def fail(name):
        with locked(tmp_path / name):
            (tmp_path / "new" / "frame").touch()
            raise InputError("no")

    for name in ("new", "empty"):
        with pytest.raises(InputError, match="no"):
            fail(name)
    assert (tmp_path / "new" / "frame").exists() and (tmp_path / "empty").is_dir()


@pytest.mark.parametrize("link", ["symlink_to", "hardlink_to"])
def test_a_lock_that_leads_to_another_file_is_refused(tmp_path, link):
    victim = tmp_path / "victim"
    victim.write_text("precious")
    (tmp_path / "run").mkdir()
    getattr(tmp_path / "run" / ".lock", link)(victim)
    with pytest.raises(InputError, match=r"\.lock: a link, or no plain file"):
        locked(tmp_path / "run").__enter__()
    assert victim.read_text() == "precious"
