"""`--plugin`: a user's own terms from the command line: run only where they are named, kept with the run, and asked for again where it is read."""

import re
import tomllib
from pathlib import Path

import jaxtyping
import pytest
from own_terms import GOOD, MODEL, plugins_of_this_test

from bayes_body.recording.session.read import save_session

FRAMES = 2


@pytest.fixture(scope="module")
def files(textured_session, tmp_path_factory):
    """The folder of a session, a model that names a plugin's terms, and the plugin."""
    folder = tmp_path_factory.mktemp("plugin")
    save_session(textured_session)
    (folder / "mine.py").write_text(GOOD, encoding="utf-8")
    (folder / "mine.toml").write_text(MODEL, encoding="utf-8")
    return folder


@pytest.fixture
def alone(cli):
    """As `cli`, but each command as in a process of its own: it knows no plugin of the one before."""

    def call(*arguments):
        with plugins_of_this_test():
            return cli(*arguments)

    return call


@pytest.fixture
def track(alone, textured_session, files):
    def call(out, *arguments, model="mine.toml", frames=FRAMES):
        return alone("track", textured_session.folder, "--out", out, "--model", files / model, "--frames", frames, *arguments)

    return call


@pytest.fixture
def guide_files(tmp_path, monkeypatch):
    """The complete likelihood and kernel of the guide, and the definition that names them."""
    # A user's code runs without checks of types.
    monkeypatch.setattr(jaxtyping.config, "jaxtyping_disable", True)
    page = (Path(__file__).parents[2] / "docs" / "guide" / "plugins.md").read_text(encoding="utf-8")
    for name in ("laplace_keypoints.py", "resample_move.py", "arm_laplace.toml"):
        text = re.search(rf"^`{name}`.*?^```\w+\n(.*?)^```$", page, re.MULTILINE | re.DOTALL)
        (tmp_path / name).write_text(text[1], encoding="utf-8")
    return tmp_path


@pytest.fixture(scope="module")
def run(files):
    return files / "run"


def test_without_the_option_nothing_foreign_is_run(track, tmp_path):
    track(tmp_path / "run").refuses("likelihood #1.kind: likelihood 'brightness' does not exist")


@pytest.mark.slow
def test_a_run_keeps_the_plugin_s_text(track, files, run):
    outcome = track(run, "--plugin", files / "mine.py")
    assert outcome.status == 0, outcome.err
    assert tomllib.loads((run / "run.toml").read_text(encoding="utf-8"))["plugins"] == {"mine.py": GOOD}


@pytest.mark.slow
def test_a_run_of_built_in_terms_keeps_none(alone, textured_session, files, tmp_path):
    arguments = ["--model", "arm", "--particles", 20, "--frames", 1, "--plugin", files / "mine.py"]
    assert alone("track", textured_session.folder, "--out", tmp_path / "run", *arguments).status == 0
    assert "plugins" not in tomllib.loads((tmp_path / "run" / "run.toml").read_text(encoding="utf-8"))


@pytest.mark.slow
@pytest.mark.parametrize("verb", [["report"], ["view"], ["export", "--to", "csv"]])
def test_what_reads_a_run_asks_for_its_plugin(alone, track, run, files, verb, tmp_path):
    if not run.exists():
        assert track(run, "--plugin", files / "mine.py").status == 0
    command = [verb[0], run, *verb[1:], "--out", tmp_path / "out"]
    alone(*command).refuses("run.toml: plugins", "the run has terms of mine.py, which is not loaded", "--plugin mine.py")
    assert alone(*command, "--plugin", files / "mine.py").status == 0


@pytest.mark.slow
def test_a_run_goes_on_with_its_plugin_only(track, run, files, tmp_path):
    track(run, "--resume").refuses("the run has terms of mine.py, which is not loaded", "give that file with --plugin")
    (tmp_path / "mine.py").write_text(GOOD.replace("** 2", "** 4"), encoding="utf-8")
    track(run, "--resume", "--plugin", tmp_path / "mine.py").refuses("mine.py changed since the run was made", "under [plugins]")
    # What Python reads is the same.
    (tmp_path / "mine.py").write_text(GOOD.replace("(name, level)", "(name,  level)") + "\n# mine\n", encoding="utf-8")
    outcome = track(run, "--resume", "--plugin", tmp_path / "mine.py", frames=FRAMES + 1)
    assert outcome.status == 0, outcome.err
    assert f"continuing at frame {FRAMES} of {FRAMES + 1}" in outcome.out


def test_models_check_knows_the_terms(alone, files):
    alone("models", "check", files / "mine.toml").refuses("'brightness' does not exist")
    outcome = alone("models", "check", files / "mine.toml", "--plugin", files / "mine.py")
    assert (outcome.status, outcome.err) == (0, "") and "brightness" in outcome.out


MOVED = ["bayes_body.errors is not where this plugin looks", "take bb.Schema, bb.Factor, bb.InputError"]
FAULTS = {
    "vector": (("jnp.sum(values[POSE] ** 2)", "values[POSE] ** 2"), ["likelihood 'brightness'", "an array of shape (4,)", "expected one number"]),
    "NaN": (("** 2)", "** 0 * jnp.nan)"), ["likelihood 'brightness'", "is NaN at the first pose"]),
    "twice": (('"observation"', '"likelihood"'), ["line 14", "likelihood 'brightness' is registered twice", "rename yours"]),
    "its own error": (("values[POSE] ** 2", "values[POSE] @ jnp.ones(7)"), ["line 17", "TypeError: dot_general requires", "correct the plugin"]),
    "a module that moved": (("import bayes_body as bb\n", "import bayes_body as bb\nfrom bayes_body.errors import InputError\n"), MOVED),
    "its observation": (("frame.images[0].mean()", "frame.pictures"), ["line 12", "AttributeError: 'Frame' object has no attribute 'pictures'"]),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_a_plugin_that_cannot_be_used(track, files, tmp_path, fault, monkeypatch):
    # A user's code runs without checks of types.
    monkeypatch.setattr(jaxtyping.config, "jaxtyping_disable", True)
    (old, new), parts = FAULTS[fault]
    assert old in GOOD
    (tmp_path / "mine.py").write_text(GOOD.replace(old, new), encoding="utf-8")
    track(tmp_path / "run", "--plugin", tmp_path / "mine.py").refuses("mine.py", *parts)


BROKEN = {
    "a wrong name": (("bb.marker_positions", "bb.marker_places"), "AttributeError: module 'bayes_body' has no attribute 'marker_places'"),
    "a wrong shape": (("[:, places] - expected", "[:, places, 0] - expected"), "Error: Incompatible shapes for broadcasting"),
    "no number": (("-distance / scale", "jnp.log(-1 - distance)"), "its log-potential: is NaN at the first pose"),
    "an array": (("return jnp.sum(jnp.where(", "return (jnp.where("), "returns an array of shape"),
}


@pytest.mark.parametrize(
    ("fault", "command"), [*((fault, ("models", "check")) for fault in BROKEN), ("a wrong shape", ("check",))], ids=[*BROKEN, "check"]
)
def test_faults_of_a_likelihood_are_found_before_the_check(alone, guide_files, fault, command):
    """They are no bug in the program: each names the file and the line, what was raised, and a remedy."""
    (old, new), said = BROKEN[fault]
    path = guide_files / "laplace_keypoints.py"
    lines = path.read_text(encoding="utf-8").splitlines()
    (line,) = [number for number, text in enumerate(lines, 1) if old in text]
    path.write_text("\n".join(lines).replace(old, new), encoding="utf-8")
    outcome = alone(*command, guide_files / "arm_laplace.toml", "--plugin", path, "--plugin", guide_files / "resample_move.py")
    outcome.refuses(f"{path}: line ", said)
    if "Error" in said:
        outcome.refuses(f"{path}: line {line}, `", "expected code that runs; correct the plugin.")


@pytest.mark.parametrize(
    "command", [pytest.param(("models", "check"), id="models check", marks=pytest.mark.slow), pytest.param(("check",), id="check")]
)
def test_faults_of_a_kernel_are_found_before_the_check(alone, guide_files, command):
    path = guide_files / "resample_move.py"
    text = path.read_text(encoding="utf-8")
    path.write_text(text.replace("return bb.Particles(states, ", "return bb.Particles(sd, "), encoding="utf-8")
    arguments = (*command, guide_files / "arm_laplace.toml", "--plugin", guide_files / "laplace_keypoints.py", "--plugin", path)
    alone(*arguments).refuses(f"{path}: line ", "kernel 'resample_move': `pose` of the particles is float32[4]; expected float32[8, 4]")
    path.write_text(text.replace("moved, (density, sd)", "moved, (density, ds)"), encoding="utf-8")
    alone(*arguments).refuses(f"{path}: line ", "NameError: name 'ds' is not defined", "correct the plugin")


def test_a_file_that_does_not_exist(track, tmp_path):
    track(tmp_path / "run", "--plugin", tmp_path / "none.py").refuses("none.py: no such file", "expected a Python file that registers terms")
