"""A study whose units are killed at random moments ends as one that was left alone, bit for bit, and nothing is computed twice."""

import os
import random
import shutil
import signal
import threading
from pathlib import Path

import pytest

from bayes_body.runs.run import run
from bayes_body.runs.settings import Settings
from bayes_body.runs.study.status import status
from bayes_body.runs.study.study import run_study
from bayes_body.runs.study.study_file import StudyFile

from .conftest import contents

FRAMES, PARTICLES = 12, 40


class Killer(threading.Thread):
    """Kills a unit at each of some numbers of stored frames, as the kernel does when memory is short."""

    def __init__(self, out: Path, moments: list[tuple[str, int]]):
        super().__init__(daemon=True)
        self._out, self._moments, self.killed, self.over = out, moments, 0, threading.Event()

    def run(self):
        for name, frame in self._moments:
            while not (self._out / name / "frames" / f"{frame:06d}.npz").exists():
                if self.over.wait(0.002):
                    return
            state = next(state for state in status(self._out)[1] if state.unit.key == name)
            if state.state == "running":
                os.kill(int((self._out / name / ".lock").read_text()), signal.SIGKILL)
                self.killed += 1


@pytest.mark.slow
def test_units_that_are_killed_end_as_those_that_are_not(looped, tmp_path):
    sessions = [tmp_path / "walk_a", tmp_path / "walk_b"]
    for session in sessions:
        shutil.copytree(looped(FRAMES), session, symlinks=True)
    out, chance, lines = tmp_path / "runs", random.Random(3), []
    killer = Killer(out, [(f"{session.name}/run_1", chance.randrange(FRAMES - 2)) for session in sessions])
    table = {"model": "arm", "kernel": "sir", "particles": PARTICLES, "pictures": False, "steps": []}
    study = StudyFile.model_validate({"sessions": [str(session) for session in sessions]} | table)
    killer.start()
    assert run_study(study, out, lines.append, bar=False)
    killer.over.set()
    killer.join()
    # A machine so fast that a unit was through proves nothing, but fails nothing either.
    assert sum("SIGKILL" in line for line in lines) == killer.killed
    undisturbed = tmp_path / "undisturbed"
    run(Settings(sessions[0], undisturbed, "arm", "sir", {"particles": PARTICLES}, 1, pictures=False), lines.append, bar=False)
    for session in sessions:
        assert contents(out / session.name / "run_1" / "posterior.nc") == contents(undisturbed / "posterior.nc")
        assert f",{FRAMES}," in next(line for line in (out / "study.csv").read_text().splitlines() if line.startswith(session.name))
    # Again: nothing is left to do.
    lines.clear()
    assert run_study(study, out, lines.append, bar=False)
    assert lines[0] == "study      2 sessions × 1 run, 2 of 2 units are done"
