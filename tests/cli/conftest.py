"""The command line in-process, and recordings that a test may damage."""

import re
import shutil
from pathlib import Path
from typing import NamedTuple

import pytest

from bayes_body.cli.main import main
from bayes_body.recording.parsec import import_parsec


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
        lines = self.err.splitlines()
        assert lines
        assert all(line.startswith("bayes-body: ") for line in lines)
        return [line.removeprefix("bayes-body: ") for line in lines]

    def refuses(self, *parts: str) -> None:
        """One sentence, with each of the parts in it."""
        (sentence,) = self.refusals
        for part in parts:
            assert part in sentence


class Recording:
    """A folder like the recording's: text files copied, image folders linked until a test asks to own one."""

    def __init__(self, original: Path, folder: Path):
        self.folder = folder
        (folder / "CALIB").mkdir(parents=True)
        for path in [*original.glob("*.txt"), *original.glob("CALIB/*.cal")]:
            shutil.copyfile(path, folder / path.relative_to(original))
        for path in [*original.glob("CAM*"), *original.glob("FG*")]:
            (folder / path.name).symlink_to(path)

    def image(self, name: str) -> Path:
        """An image that may be replaced; the others of its folder are links."""
        path = self.folder / name
        original = path.parent.resolve()
        path.parent.unlink()
        path.parent.mkdir()
        for other in original.iterdir():
            (path.parent / other.name).symlink_to(other)
        content = path.read_bytes()
        path.unlink()
        path.write_bytes(content)
        return path

    def calibration(self, change) -> Path:
        """The first camera's, rewritten as `change` of its numbers."""
        path = self.folder / "CALIB" / "Camera1.cal"
        path.write_text("\n".join(change(path.read_text().split())))
        return path


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


@pytest.fixture
def recording(bodytrack, tmp_path) -> Recording:
    return Recording(bodytrack, tmp_path / "source")


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
