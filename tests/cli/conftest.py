"""The command line in-process, the real recording's session, and a user's own model."""

import re
from pathlib import Path
from typing import NamedTuple

import pytest

from bayes_body.cli.main import main
from bayes_body.recording.readers.parsec import import_parsec

# A line of base/progress.py.
PROGRESS = re.compile(r"\[\d\d:\d\d:\d\d\] ")


class Outcome(NamedTuple):
    """How a command ended: exit status, and what it wrote."""

    status: int
    out: str
    err: str

    @property
    def refusals(self) -> list[str]:
        """What a user reads after a wrong input: sentences on standard error, status 2, nothing of the program's inside."""
        assert self.status == 2, self.err
        assert "Traceback" not in self.out + self.err
        lines = [line for line in self.err.splitlines() if not PROGRESS.match(line)]
        assert lines
        assert all(line.startswith("bayes-body: ") for line in lines)
        return [line.removeprefix("bayes-body: ") for line in lines]

    def refuses(self, *parts: str) -> None:
        """One sentence, with each of the parts in it."""
        (sentence,) = self.refusals
        for part in parts:
            assert part in sentence


@pytest.fixture
def cli(capsys):
    """`cli("track", folder, "--runs", 2)`: the command's outcome."""

    def call(*arguments) -> Outcome:
        capsys.readouterr()
        with pytest.raises(SystemExit) as stopped:
            main([str(argument) for argument in arguments])
        out, err = capsys.readouterr()
        return Outcome(stopped.value.code, out, re.sub(r"\x1b\[\d*m", "", err))

    return call


@pytest.fixture(scope="session")
def walk(bodytrack, tmp_path_factory) -> Path:
    """The session of the real recording."""
    folder = tmp_path_factory.mktemp("walk")
    import_parsec(bodytrack, folder)
    return folder


# A user's own: what ships may change.
MODEL = """
title  = "Mine"
source = "nobody"

[body]
name = "deutscher_31"

[dynamics]
kind = "diffusion"

[dynamics.sd_m]
"root_*" = 0.015

[dynamics.sd_deg]
root_yaw = 3.0
"root_*" = 1.0
"?_knee" = 5.0
"[!lr]*" = 1.5
"?_[!k]*" = 2.5

[[likelihood]]
kind = "silhouette_edges"
precision = 1.0
lookup = "nearest"
surface_samples = [6, 4]

[likelihood.observation]
edge_threshold = 20.0

[[constraint]]
kind = "intersection"
mode = "hard"

[kernel]
kind = "annealed"
layers = 5
"""


@pytest.fixture
def own_model(tmp_path):
    """A model file of the user's own: MODEL with replacements; each must have something to replace."""

    def write(*changes: tuple[str, str]) -> Path:
        text = MODEL
        for old, new in changes:
            assert old in text
            text = text.replace(old, new)
        path = tmp_path / "mine.toml"
        path.write_text(text, encoding="utf-8")
        return path

    return write
