"""`bayes-body models`: the shipped definitions, and a sentence for each thing that is wrong with a user's own."""

import json
import shutil
import tomllib
from pathlib import Path

import jsonschema
import pytest

from bayes_body.base.errors import RunWarning
from bayes_body.base.files import shipped
from bayes_body.model.definition import FORMER_NAMES, load_definition

MODELS = Path(__file__).parents[2] / "models"


def test_the_list_names_every_definition(cli):
    outcome = cli("models")
    assert outcome.status == 0
    listed = {line.split()[0] for line in outcome.out.splitlines()}
    assert {"arm", "deutscher_2005"} <= listed
    assert {path.stem for path in MODELS.glob("*.toml")} <= listed


@pytest.mark.parametrize(("former", "today"), [(former, today) for today, former in FORMER_NAMES.items()])
def test_a_former_name_works_with_a_note(former, today):
    with pytest.warns(RunWarning, match=f"the model '{former}' is now called '{today}'"):
        assert load_definition(former) == load_definition(today)


@pytest.mark.slow
def test_definitions_inside_the_package_are_found_first(cli, monkeypatch, tmp_path):
    shutil.copytree(MODELS, tmp_path / "bayes_body" / "_models")
    (tmp_path / "bayes_body" / "_models" / "deutscher_2005.toml").unlink()
    monkeypatch.setattr(shipped, "__file__", str(tmp_path / "bayes_body" / "base" / "files" / "shipped.py"))
    outcome = cli("models")
    assert str(tmp_path / "bayes_body" / "_models") in outcome.out.replace("\n", "")
    assert "deutscher_2005" not in outcome.out
    assert cli("models", "check", "arm").status == 0


@pytest.mark.parametrize("name", sorted(path.stem for path in MODELS.glob("*.toml")))
def test_shipped_definitions_are_sound(cli, name):
    outcome = cli("models", "check", name)
    assert (outcome.status, outcome.err) == (0, "")
    assert "valid" in outcome.out


def test_the_schema_for_editors_accepts_every_definition_and_refuses_a_wrong_key(cli):
    outcome = cli("models", "schema")
    validator = jsonschema.Draft202012Validator(json.loads(outcome.out))
    for path in MODELS.glob("*.toml"):
        document = tomllib.loads(path.read_text(encoding="utf-8"))
        assert [error.message for error in validator.iter_errors(document)] == []
        document["kernel"]["partciles"] = 5
        assert not validator.is_valid(document)


def test_a_model_that_does_not_exist(cli):
    cli("models", "check", "deutscher_205").refuses("'deutscher_205'", "did you mean 'deutscher_2005'?")


def test_a_file_that_does_not_exist(cli, tmp_path):
    cli("models", "check", tmp_path / "mine.toml").refuses(str(tmp_path / "mine.toml"), "no such file", "check the path")


FAULTS = {
    "syntax": (("precision = 1.0", "precision = = 1"), ["line ", "column ", "precision = = 1", "expected TOML"]),
    "unknown key": (("edge_threshold", "edge_treshold"), ["likelihood #1.observation: edge_treshold", "unknown key", "'edge_threshold'"]),
    "unknown placement": (('"deutscher_31"', '"deutscher_31"\nplacement = "loose"'), ["body.placement: 'loose'", 'expected "angles" or "parts"']),
    "angles walk, parts placed": (
        ('[body]\nname = "deutscher_31"', '[body]\nplacement = "parts"\nname = "person_31"'),
        ["dynamics 'diffusion'", 'placement = "parts"', 'expected placement = "angles"', 'kind = "rigid_walk"'],
    ),
    "joints of parts, angles placed": (
        ("[kernel]", '[[potential]]\nkind = "kinematic"\n\n[kernel]'),
        ["potential 'kinematic'", 'placement = "angles"', 'expected placement = "parts"'],
    ),
    "unknown kernel": (('kind = "annealed"', 'kind = "aneealed"'), ["kernel.kind", "'aneealed'", "did you mean 'annealed'?"]),
    "unknown body": (('"deutscher_31"', '"deutscher_13"'), ["body.name", "'deutscher_13'", "did you mean 'deutscher_31'?"]),
    "NaN": (("precision = 1.0", "precision = nan"), ["likelihood #1", "precision = nan", "expected a finite number"]),
    "negative": (("root_yaw = 3.0", "root_yaw = -3.0"), ["dynamics", "root_yaw = -3.0", "expected a number greater than 0"]),
    "sd for no dof": (('"?_knee"', '"?_kneee"'), ["dynamics.sd_deg.?_kneee", "matches no dof", "did you mean"]),
    "sd in the wrong unit": (("root_yaw = 3.0", "root_yaw = 3.0\nroot_x = 1.0"), ["dynamics.sd_deg.root_x", "matches no dof of the body in degrees"]),
    "dof without sd": (('"?_knee" = 5.0\n', ""), ["'l_knee'", "no standard deviation", "expected one for every dof", "add"]),
    "text for a number": (("layers = 5", 'layers = "five"'), ["kernel", 'layers = "five"', "expected a whole number", "without quotes"]),
    "choice": (('mode = "hard"', 'mode = "firm"'), ["constraint #1", 'mode = "firm"', "known: hard, soft"]),
    "too few": (("[6, 4]", "[6]"), ["surface_samples = [6]", "expected 2 entries", "add what is missing"]),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_one_fault_is_one_sentence(cli, own_model, fault):
    change, parts = FAULTS[fault]
    path = own_model(change)
    cli("models", "check", path).refuses(str(path), *parts)


@pytest.mark.parametrize("fault", FAULTS)
def test_tracking_refuses_it_with_the_same_sentence(cli, own_model, walk, tmp_path, fault):
    path = own_model(FAULTS[fault][0])
    outcome = cli("track", walk, "--model", path, "--out", tmp_path / "run")
    assert outcome.refusals == cli("models", "check", path).refusals
    assert not (tmp_path / "run").exists()


def test_five_faults_are_five_sentences(cli, own_model):
    path = own_model(
        ('"deutscher_31"', '"deutscher_13"'),
        ("root_yaw = 3.0", "root_yaw = -3.0"),
        ('lookup = "nearest"', 'lookup = "nearst"'),
        ('mode = "hard"', 'mode = "firm"'),
        ('kind = "annealed"', 'kind = "aneealed"'),
    )
    sentences = cli("models", "check", path).refusals
    assert len(sentences) == 5
    assert all(sentence.startswith(str(path)) for sentence in sentences)


BODY = """
[body]
title  = "Two sticks"
source = "nobody"

[body.lengths_of_height]
upper = 0.2
lower = 0.15

[[body.joint]]
name = "shoulder"
parent = "world"
dofs = [{ name = "swing", axis = "x", low_deg = -150, high_deg = 60 }]

[[body.joint]]
name = "elbow"
parent = "shoulder"
offset = { z = "upper" }
dofs = [{ name = "bend", axis = "y", low_deg = -150, high_deg = 0 }]

[[body.part]]
name = "upper_arm"
joint = "shoulder"
length = "upper"
radius_of_height = [0.03, 0.02]

[[body.part]]
name = "forearm"
joint = "elbow"
length = "lower"
radius_of_height = [0.02, 0.01]
"""
# What replaces the body and the standard deviations of the fixture's model.
WRITTEN_OUT = (
    ('[body]\nname = "deutscher_31"\n', BODY),
    ('[dynamics.sd_m]\n"root_*" = 0.015\n', ""),
    ('root_yaw = 3.0\n"root_*" = 1.0\n"?_knee" = 5.0\n"[!lr]*" = 1.5\n"?_[!k]*" = 2.5\n', '"*" = 2.0\n'),
)
BODY_FAULTS = {
    "low above high": (("low_deg = -150, high_deg = 0", "low_deg = 0, high_deg = -150"), ["'bend'", "low_deg = 0", "high_deg = -150", "swap them"]),
    "one limit": (("low_deg = -150, high_deg = 0", "low_deg = -150"), ["'bend'", "only one limit", "low_deg and high_deg", "neither"]),
    "metres of an angle": (("high_deg = 0", "high_m = 0"), ["'bend'", "is an angle", "low_deg and high_deg"]),
    "cycle": (('parent = "world"', 'parent = "elbow"'), ["shoulder -> elbow -> shoulder", "cycle", "'world'"]),
    "NaN": (("high_deg = 60", "high_deg = nan"), ["joint 'shoulder'", "'swing'", "high_deg = nan", "expected a finite number"]),
    "no such length": (('length = "lower"', 'length = "lowre"'), ["'forearm'", "'lowre'", "did you mean 'lower'?"]),
    "no such parent": (('parent = "shoulder"', 'parent = "sholder"'), ["'elbow'", "'sholder'", "did you mean 'shoulder'?"]),
    "twice": (('name = "forearm"', 'name = "upper_arm"'), ["part 'upper_arm'", "2 times", "a unique name"]),
}


def test_a_body_may_be_written_out(cli, own_model):
    assert cli("models", "check", own_model(*WRITTEN_OUT)).status == 0


@pytest.mark.parametrize("fault", BODY_FAULTS)
def test_a_body_written_out_that_cannot_be_used(cli, own_model, fault):
    change, parts = BODY_FAULTS[fault]
    path = own_model(*WRITTEN_OUT, change)
    cli("models", "check", path).refuses(str(path), *parts)


@pytest.mark.slow
def test_the_axes_of_a_body_are_drawn_and_its_angles_named(cli, tmp_path):
    outcome = cli("models", "axes", "keypoints", "--out", tmp_path / "axes.png")
    assert outcome.status == 0, outcome.err
    assert "36 clinical angles of the body person_35: pelvic_rotation," in outcome.out and (tmp_path / "axes.png").stat().st_size > 20_000
    cli("models", "axes", "keypoints", "--out", tmp_path / "axes.png").refuses("already exists", "--overwrite")


def test_segments_that_cannot_be_right(cli, tmp_path):
    body = (MODELS / "bodies" / "arm_4.toml").read_text(encoding="utf-8")
    (tmp_path / "arm.toml").write_text((MODELS / "arm.toml").read_text(encoding="utf-8").replace('"arm_4"', '"body.toml"'), encoding="utf-8")
    forearm = 'l_forearm = { joint = "elbow", forward = "-x", up = "-z" }'
    wrong = {
        'l_forearm = { joint = "elbo", forward = "-x", up = "-z" }': ("segment 'l_forearm'", "'elbo' does not exist", "did you mean 'elbow'?"),
        'l_forearm = { joint = "elbow", forward = "-x", up = "x" }': ("forward = '-x' and up = 'x' are the same axis", "two different axes"),
        'l_forarm = { joint = "elbow", forward = "-x", up = "-z" }': ("segment 'l_forarm' is unknown", "did you mean 'l_forearm'?"),
        "": ("no joint with clinical angles", "both sides of a joint"),
    }
    for line, parts in wrong.items():
        assert forearm in body
        (tmp_path / "body.toml").write_text(body.replace(forearm, line), encoding="utf-8")
        cli("models", "axes", tmp_path / "arm.toml", "--out", tmp_path / "axes.png").refuses(*parts)
