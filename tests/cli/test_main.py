"""The verbs as a whole: help, version, interruption, an error of our own, and errors of the surroundings."""

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from bayes_body import __version__
from bayes_body.base.errors import InputError, input_error
from bayes_body.cli import models
from bayes_body.cli.terminal import say, show


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


@pytest.mark.slow
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


@pytest.fixture
def failing(monkeypatch):
    """`failing(error)`: `models check` raises it."""

    def call(error):
        def fail(name):
            raise error

        monkeypatch.setattr(models, "checked_definition", fail)

    return call


def test_termination(cli, monkeypatch):
    before = signal.getsignal(signal.SIGTERM)
    monkeypatch.setattr(models, "checked_definition", lambda name: os.kill(os.getpid(), signal.SIGTERM))
    outcome = cli("models", "check", "arm")
    assert (outcome.status, outcome.err) == (143, "bayes-body: terminated.\n")
    assert signal.getsignal(signal.SIGTERM) == before


EMPTY = {
    "--out": [
        "demo --out",
        "report run --out",
        "view run --out",
        "picture run --out",
        "simulate walk --out",
        "export run --to csv --out",
        "track session --out",
        "mocap x.bvh --out",
    ],
    "an argument": ["track", "report", "view", "picture", "import parsec source", "models check", "learn walking-cycle"],
    "--json": ["benchmark --json"],
}


@pytest.mark.parametrize(("where", "command"), [(where, command) for where, commands in EMPTY.items() for command in commands])
def test_an_empty_argument_is_not_the_current_folder(cli, tmp_path, monkeypatch, where, command):
    monkeypatch.chdir(tmp_path)
    cli(*command.split(), "").refuses(f"{where}: empty", "expected a name, a path or a number", "leave it out")
    assert not list(tmp_path.iterdir())


def test_an_empty_value_after_an_equals_sign(cli):
    cli("demo", "--out=").refuses("--out: empty")


LONG = "n" * 300
TOO_LONG = [
    *(["track", LONG], ["report", LONG], ["view", LONG], ["picture", LONG], ["export", LONG, "--to", "csv"], ["import", "opencv", LONG, "x"]),
    *(["simulate", "walk", "--out", LONG], ["simulate", "walk", "--out", "s", "--rig", LONG]),
    *(["models", "check", LONG], ["check", LONG], ["mocap", "x.bvh", "--out", f"{LONG}.npz"]),
]


@pytest.mark.parametrize("arguments", TOO_LONG, ids=lambda arguments: arguments[0])
def test_a_name_that_is_too_long_for_the_file_system(cli, tmp_path, monkeypatch, arguments):
    monkeypatch.chdir(tmp_path)
    cli(*arguments).refuses(LONG, "File name too long", "check the path")


@pytest.mark.parametrize(
    ("error", "said"),
    [
        (PermissionError(13, "Permission denied", "secret"), "secret: cannot be used (Permission denied)"),
        (MemoryError(), "memory: not enough for this command (out of memory)"),
        (
            RuntimeError("RESOURCE_EXHAUSTED: Out of memory allocating 4 bytes."),
            "memory: not enough for this command (RESOURCE_EXHAUSTED: Out of memory",
        ),
    ],
    ids=["file", "memory", "memory of XLA"],
)
def test_what_the_surroundings_refuse_is_a_sentence(cli, failing, error, said):
    failing(error)
    cli("models", "check", "arm").refuses(said)


def test_control_characters_do_not_reach_the_terminal(cli, failing, monkeypatch):
    name = "\x1b]0;title\x07a\nbayes-body: all is well\udcff"
    failing(input_error(name, "wrong", "right", "correct it"))
    cli("models", "check", "arm").refuses(r"\x1b]0;title\x07a\nbayes-body: all is well\udcff: wrong")
    # Sentences that were not made by `input_error` keep the line breaks between them.
    failing(InputError("first\x1b[31m\nsecond"))
    assert cli("models", "check", "arm").err == "bayes-body: first\\x1b[31m\nsecond\n"
    monkeypatch.setattr(models, "checked_definition", lambda _: say(f"camera {name}") or 1 / 0)
    assert cli("models", "check", "arm").out == "camera \\x1b]0;title\\x07a\nbayes-body: all is well\\udcff\n"


def test_control_characters_in_a_table_neither(capsys):
    from rich.table import Table

    table = Table("marker", box=None)
    table.add_row("\x1b[31m[bold]hip[/bold]")
    show(table, "a sentence")
    out = capsys.readouterr().out
    assert "\x1b" not in out and r"\x1b[31m[bold]hip[/bold]" in out and out.endswith("a sentence\n")


# Each command with its streams, as a shell has them: the status, and what the stream that is left says.
STREAMS = {
    "full output": ("--version > /dev/full", 1, "standard output cannot be written (No space left on device)"),
    "full output of a help": ("--help > /dev/full", 1, "standard output cannot be written (No space left on device)"),
    "nobody reads": ("--version | true", 1, "standard output cannot be written (Broken pipe)"),
    "closed output": ("--version >&-", 0, ""),
    "full error": ("demo --seed -1 2> /dev/full", 2, "--seed: -1"),
    "closed error": ("demo --seed -1 2>&-", 2, "--seed: -1"),
    "both closed": ("demo --seed -1 >&- 2>&-", 2, ""),
}


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no /dev/full, which is a full disk")
@pytest.mark.parametrize("case", STREAMS)
def test_a_stream_that_cannot_be_written(case):
    words, status, said = STREAMS[case]
    line = f"set -o pipefail; {sys.executable} -m bayes_body.cli.main {words}"
    done = subprocess.run(["bash", "-c", line], capture_output=True, text=True, check=False)
    assert done.returncode == status
    assert said in done.stdout + done.stderr and "Traceback" not in done.stderr and "Exception ignored" not in done.stderr
    assert (done.stdout + done.stderr).count("\n") == (1 if said else 0)


def test_a_current_folder_that_was_deleted(cli, tmp_path, monkeypatch):
    gone = tmp_path / "gone"
    gone.mkdir()
    monkeypatch.chdir(gone)
    gone.rmdir()
    cli("models", "check", "arm").refuses("the current folder: does not exist any more", "change to another folder")


@pytest.mark.parametrize("platform", ["cuda", pytest.param("kuda", marks=pytest.mark.slow)])
def test_a_platform_that_jax_does_not_have(platform):
    code = "import jax; jax.devices()"
    environment = {**os.environ, "JAX_PLATFORMS": platform}
    if subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, check=False).returncode == 0:
        pytest.skip(f"this machine has {platform}")
    command = [sys.executable, "-m", "bayes_body.cli.main", "models", "check", "arm"]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 2
    assert f"JAX_PLATFORMS={platform}" in done.stderr and "correct or unset it" in done.stderr and "internal error" not in done.stderr
