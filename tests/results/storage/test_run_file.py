"""run.toml: what it keeps comes back, and what changed since is named."""

import copy
import tomllib

import pytest

from bayes_body.base.errors import InputError
from bayes_body.model.definition import load_definition
from bayes_body.results.storage.run_changes import refuse_changes, run_id
from bayes_body.results.storage.run_file import describe, read_run_file, write_run_file

SESSION = "title = \"blobs\"\nfps = 60.0\n# a \"comment\" with '''quotes'''\n[[camera]]\nname = \"a\"\nfocal_px = [200.0, 205.0]\n"


@pytest.fixture
def record(tmp_path):
    (tmp_path / "session.toml").write_text(SESSION, encoding="utf-8")
    settings = {"runs": 2, "seed": 3, "frames": None, "init": "auto", "recover": False}
    return describe(
        tmp_path, "arm", load_definition("arm"), "annealed", {"particles": 40, "layers": 2, "unset": None}, settings, {"images of a": "0123"}
    )


def test_it_comes_back(tmp_path, record):
    known_as = write_run_file(tmp_path, record)
    read = read_run_file(tmp_path)
    assert known_as == read["check"]["run"] == run_id(read)
    refuse_changes(tmp_path, read, record)
    assert read["run"] == {"session": str(tmp_path), "model": "arm", "runs": 2, "seed": 3, "init": "auto", "recover": False}
    assert read["kernel"] == {"kind": "annealed", "particles": 40, "layers": 2}
    assert read["session"]["text"] == SESSION
    assert tomllib.loads(read["definition"]["text"])["kernel"] == {"kind": "sir", "particles": 2000}


def _put(table, key, value):
    return lambda record: record[table].update({key: value})


def _edit(table, key, old, new):
    return lambda record: record[table].update({key: record[table][key].replace(old, new)})


CHANGES = {
    "seed": (_put("run", "seed", 4), "--seed was 3 and is now 4"),
    "runs": (_put("run", "runs", 1), "--runs was 2 and is now 1"),
    "init": (_put("run", "init", "given"), "--init was auto and is now given"),
    "recover": (_put("run", "recover", True), "--recover was False and is now True"),
    "model": (_put("run", "model", "other/mine.toml"), "--model was arm and is now mine"),
    "kernel": (_put("kernel", "kind", "sir"), "kernel.kind was annealed and is now sir"),
    "an option": (_put("kernel", "particles", 41), "kernel.particles was 40 and is now 41"),
    "a new option": (_put("kernel", "moves", 2), "kernel.moves was not set and is now 2"),
    "a decoder": (_put("versions", "av", "0.1"), "the version of av was .* and is now 0.1"),
    "the precision": (_put("machine", "precision", "float64"), "the precision was float32 and is now float64"),
    "the images": (_put("inputs", "images of a", "4567"), r"the recording has changed \(images of a\)"),
    "a version": (_put("versions", "jax", "0.1"), "the version of jax was .* and is now 0.1"),
    "the model's text": (_edit("definition", "text", "precision = 200.0", "precision = 10.0"), "the model's file: likelihood.1.precision was 200.0"),
    "the body's text": (_edit("definition", "body_text", "height_m = 1.75", "height_m = 1.76"), "the body's file: height_m was 1.75 and is now 1.76"),
    "the session": (_edit("session", "text", "205.0", "210.0"), "session.toml: camera.1.focal_px.2 was 205.0 and is now 210.0"),
}


@pytest.mark.parametrize("change", CHANGES)
def test_what_changed_is_named(tmp_path, record, change):
    make, said = CHANGES[change]
    now = copy.deepcopy(record)
    make(now)
    remedy = "expected the settings with which the run started; change it back, or start a new run"
    with pytest.raises(InputError, match=f"cannot be continued: .*{said}.*; {remedy}"):
        refuse_changes(tmp_path, record, now)


def test_what_no_number_depends_on_may_change(tmp_path, record):
    now = copy.deepcopy(record)
    for change in (
        _put("run", "frames", 9),
        _put("run", "session", "/elsewhere"),
        _put("versions", "arviz", "9"),
        _put("machine", "platform", "another"),
        _edit("session", "text", "# a", "# another"),
        _edit("session", "text", "60.0", "60"),
    ):
        change(now)
    refuse_changes(tmp_path, record, now)
    assert run_id(now) == run_id(record)
    # What a model says of itself is part of the id: a continued run keeps the texts with which it began.
    _edit("definition", "text", 'title  = "', 'title  = "Renamed: ')(now)
    refuse_changes(tmp_path, record, now)


def test_many_changes_are_counted(tmp_path, record):
    now = copy.deepcopy(record)
    now["kernel"] |= {f"option_{number}": number for number in range(7)}
    with pytest.raises(InputError, match="; 3 more differ; expected"):
        refuse_changes(tmp_path, record, now)


@pytest.mark.parametrize("change", ["seed = 3", "focal_px = [200.0, 205.0]", "precision = 200.0", "particles = 40"])
def test_a_change_by_hand_is_noticed(tmp_path, record, change):
    write_run_file(tmp_path, record)
    path = tmp_path / "run.toml"
    text = path.read_text(encoding="utf-8")
    path.write_text(text + "# a comment", encoding="utf-8")
    read_run_file(tmp_path)
    assert change in text
    path.write_text(text.replace(change, change.replace("0", "1").replace("3", "4")), encoding="utf-8")
    with pytest.raises(InputError, match=r"run\.toml: was changed since it was written"):
        read_run_file(tmp_path)


TYPES = {
    "seed = 3": 'seed = "x"',
    "frames = 9": "frames = true",
    'kind = "annealed"': "kind = 5",
    "runs = 2": "runs = 0",
}


@pytest.mark.parametrize("before", TYPES)
def test_wrong_types_are_sentences(tmp_path, record, before):
    record["run"]["frames"] = 9
    write_run_file(tmp_path, record)
    path = tmp_path / "run.toml"
    text = path.read_text(encoding="utf-8")
    assert before in text
    path.write_text(text.replace(before, TYPES[before], 1), encoding="utf-8")
    with pytest.raises(InputError, match=r"run\.toml: "):
        read_run_file(tmp_path)


@pytest.mark.parametrize(
    ("text", "said"), [("", "format none: written by another version"), ("[run", "line 1"), ("[check]\nformat = 1\n", "format 1")]
)
def test_a_run_file_that_is_none(tmp_path, text, said):
    (tmp_path / "run.toml").write_text(text)
    with pytest.raises(InputError, match=said):
        read_run_file(tmp_path)
