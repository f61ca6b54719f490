"""The verbs as a whole: help, version, interruption, and an error of our own."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from bayes_body import __version__
from bayes_body.cli import models


def test_help_imports_nothing_that_takes_a_second_to_import():
    done = subprocess.run([sys.executable, "-X", "importtime", "-m", "bayes_body.cli.main", "--help"], capture_output=True, text=True, check=False)
    assert done.returncode == 0
    assert "Traceback" not in done.stdout + done.stderr
    assert {"track", "import", "models"} <= set(done.stdout.split())
    assert not [line for line in done.stderr.splitlines() if line.split("|")[-1].strip() in ("jax", "cv2", "arviz", "numpy")]


@pytest.mark.parametrize("verb", ["", "track", "import", "import parsec", "models", "models list", "models check"])
def test_every_verb_has_help(cli, verb):
    outcome = cli(*verb.split(), "--help")
    assert outcome.status == 0
    assert "Usage" in outcome.out


def test_version(cli):
    assert cli("--version").out == f"bayes-body {__version__}\n"


@pytest.mark.parametrize("arguments", [["trak"], ["track"], ["track", "walk", "--out", "x", "--runs", "two"], ["models", "chek"]])
def test_a_mistyped_command_is_a_usage_error(cli, arguments):
    outcome = cli(*arguments)
    assert outcome.status == 2
    assert "Usage" in outcome.err
    assert "Traceback" not in outcome.err


def test_a_fault_of_the_program_is_a_sentence_that_names_a_file_with_the_details(cli, monkeypatch):
    monkeypatch.setattr(models, "checked_definition", lambda name: 1 / 0)
    outcome = cli("models", "check", "arm")
    assert outcome.status == 1
    assert "Traceback" not in outcome.err
    log = Path(outcome.err.split("details in ")[1].strip().rstrip("."))
    assert "ZeroDivisionError" in log.read_text()
    log.unlink()


def test_a_path_that_is_not_utf8_is_refused_before_anything_is_done(tmp_path):
    folder = tmp_path / "gehört"
    folder.mkdir()
    bad = os.fsdecode(os.fsencode(tmp_path) + b"/\xff")
    Path(bad).mkdir()

    def said(*arguments: str, cwd: str | Path = tmp_path, **environment: str) -> str:
        command = [sys.executable, "-m", "bayes_body.cli.main", *arguments]
        done = subprocess.run(command, cwd=cwd, env={**os.environ, **environment}, capture_output=True, timeout=120, check=False)
        assert done.returncode == 2
        return done.stderr.decode()

    expected = "a byte that is not UTF-8 in the path; expected a path in UTF-8; rename the folder or the file."
    assert expected in said("track", "session", "--out", bad)
    assert expected in said("report", "run", cwd=bad)
    assert "no session.toml in it" in said("track", str(folder))
    posix = said("track", str(folder), LC_ALL="C", PYTHONUTF8="0", PYTHONCOERCECLOCALE="0")
    assert "Python's encoding of paths is another one; expected a locale in UTF-8; set LC_ALL=C.UTF-8 or PYTHONUTF8=1" in posix


def test_interruption(cli, monkeypatch):
    def interrupted(name):
        raise KeyboardInterrupt

    monkeypatch.setattr(models, "checked_definition", interrupted)
    outcome = cli("models", "check", "arm")
    assert (outcome.status, outcome.err) == (130, "bayes-body: interrupted.\n")
