"""The session that programs and the guide's examples work on."""

import shlex
from pathlib import Path

import pytest
from programs.pages import FIRST_RUN, blocks

from bayes_body.cli.main import main
from bayes_body.recording.readers.parsec import import_parsec


@pytest.fixture(scope="session")
def walk(bodytrack, tmp_path_factory) -> Path:
    """The session of the real recording, in a folder `walk` as the guide calls it."""
    folder = tmp_path_factory.mktemp("guide") / "walk"
    import_parsec(bodytrack, folder)
    return folder


@pytest.fixture(scope="module")
def walked(walk) -> Path:
    """The folder in which the guide's commands were given: with the session `walk` and the run `walk_run`."""
    (command,) = [line for line in "".join(blocks(FIRST_RUN, "sh")).splitlines() if line.startswith("bayes-body track")]
    folder = walk.parent
    if not (folder / "walk_run").exists():
        arguments = [str(folder / each) if each in ("walk", "walk_run") else each for each in shlex.split(command)[1:]]
        with pytest.raises(SystemExit) as stopped:
            main([*arguments, "--particles", "50"])
        assert stopped.value.code == 0
    return folder


@pytest.fixture
def run(program_runner):
    """`run(path, "--quick")`: the outcome of a program (`shared_fixtures.program_runner`)."""
    return program_runner
