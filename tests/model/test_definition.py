"""Definitions: found by name or path, in a checkout or a wheel; what is read is what was written; what is wrong is a sentence each."""

import shutil
from pathlib import Path

import pytest

from bayes_body.base.errors import InputError
from bayes_body.base.files import shipped
from bayes_body.base.files.shipped import definitions_folder
from bayes_body.base.registry import names
from bayes_body.model.definition import definition_names, load_body, load_definition

ROOT = Path(__file__).parents[2]
TEXT = """
title  = "Mine"
source = "nobody"

[body]
name = "arm_4"

[dynamics]
kind = "diffusion"
at_fps = 30

[dynamics.sd_deg]
"shoulder_*" = 3.0
elbow = 4

[[likelihood]]
kind = "silhouette_edges"
precision = 7.0

[likelihood.observation]
edge_threshold = 11.0

[[likelihood]]
kind = "silhouette_edges"
terms = ["edges"]

[kernel]
kind = "sir"
particles = 12
"""


@pytest.fixture
def write(tmp_path):
    """A model file: TEXT with replacements; each must have something to replace."""

    def call(*changes: tuple[str, str], encoding: str = "utf-8") -> Path:
        text = TEXT
        for old, new in changes:
            assert old in text
            text = text.replace(old, new)
        path = tmp_path / "mine.toml"
        path.write_text(text, encoding=encoding)
        return path

    return call


def sentences(path: Path) -> list[str]:
    with pytest.raises(InputError) as error:
        load_definition(path)
    return str(error.value).splitlines()


@pytest.mark.parametrize("name", definition_names())
def test_shipped_definitions_load_and_say_what_they_are(name):
    shipped = load_definition(name)
    assert shipped.name == name
    assert shipped.title
    assert shipped.source
    assert shipped.text == (ROOT / "models" / f"{name}.toml").read_text(encoding="utf-8")
    assert shipped.kernel.kind in names("kernel")
    assert shipped.body_name in definition_names("bodies")


@pytest.mark.parametrize("name", definition_names("bodies"))
def test_shipped_bodies_load(name):
    body = load_body(name)
    assert body.joints
    assert body.parts
    dofs = [dof.name for joint in body.joints for dof in joint.dofs if not dof.is_fixed]
    # By convention a body's name ends in its number of dofs.
    assert int(name.rsplit("_", 1)[1]) == len(dofs) == len(set(dofs))


def test_what_is_read_is_what_was_written(write):
    mine = load_definition(write())
    assert (mine.name, mine.title, mine.source, mine.body_name) == ("mine", "Mine", "nobody", "arm_4")
    assert mine.dynamics.kind == "diffusion"
    assert mine.dynamics.options.at_fps == 30
    assert dict(mine.dynamics.options.sd_deg) == {"shoulder_*": 3.0, "elbow": 4.0}
    first, second = mine.likelihoods
    assert (first.options.precision, first.observation.edge_threshold) == (7.0, 11.0)
    assert (second.options.terms, second.options.precision, second.observation.edge_threshold) == (("edges",), 1.0, 20.0)
    assert mine.constraints == ()
    assert (mine.kernel.kind, mine.kernel.options.particles) == ("sir", 12)


def test_by_a_text_as_well_as_by_a_path(write):
    path = write()
    assert load_definition(str(path)) == load_definition(path)


def test_a_byte_order_mark_is_no_fault(write):
    assert load_definition(write(encoding="utf-8-sig")).text == TEXT


def test_a_body_of_one_s_own_by_path(write, tmp_path):
    shutil.copyfile(ROOT / "models" / "bodies" / "arm_4.toml", tmp_path / "longer_arm.toml")
    mine = load_definition(write(('"arm_4"', f'"{tmp_path}/longer_arm.toml"')))
    assert mine.body == load_definition("arm").body


@pytest.fixture
def wheel(monkeypatch, tmp_path) -> Path:
    """The package's folder as a wheel installs it: definitions inside."""
    package = tmp_path / "site-packages" / "bayes_body"
    shutil.copytree(ROOT / "models", package / "_models")
    monkeypatch.setattr(shipped, "__file__", str(package / "base" / "files" / "shipped.py"))
    return package


def test_definitions_of_a_wheel_are_found(wheel):
    before = definition_names()
    assert definitions_folder() == wheel / "_models"
    shutil.copyfile(wheel / "_models" / "arm.toml", wheel / "_models" / "my_arm.toml")
    assert set(definition_names()) == {*before, "my_arm"}
    assert load_definition("my_arm").body_name == "arm_4"


def test_definitions_of_a_checkout_are_found(monkeypatch, tmp_path):
    (tmp_path / "bayes_body").mkdir()
    (tmp_path / "models").mkdir()
    monkeypatch.setattr(shipped, "__file__", str(tmp_path / "bayes_body" / "base" / "files" / "shipped.py"))
    assert definitions_folder() == tmp_path / "models"
    assert definition_names() == ()


@pytest.mark.parametrize(
    ("name", "said"), [("amr", "did you mean 'arm'?"), ("gorilla", "known: arm, arm_edges, arm_markers")], ids=["nearly", "not at all"]
)
def test_a_wrong_name(name, said):
    assert f"model '{name}' does not exist; {said}" in sentences(Path(name))[0]


FAULTS = {
    "missing title": (('title  = "Mine"', ""), "title: missing; expected a string"),
    "unknown table": (("[kernel]", "[colour]\nred = 1\n[kernel]"), "colour: unknown key"),
    "no kernel": (('[kernel]\nkind = "sir"\nparticles = 12\n', ""), "kernel: missing"),
    "no kind": (('kind = "sir"\n', ""), "kernel.kind: missing; expected a string; add it to kernel"),
    "key beside a body's name": (('name = "arm_4"', 'name = "arm_4"\nheight_m = 2.0'), "body.height_m: unknown key beside a body's name"),
    "placement": (
        ('name = "arm_4"', 'name = "arm_4"\nplacement = "loose"'),
        'body.placement: \'loose\'; expected "angles" or "parts"',
    ),
    "body's name a number": (('"arm_4"', "4"), "body.name: 4; expected a string"),
    "second likelihood": (('["edges"]', '["edge"]'), "likelihood #2: terms #1 = \"edge\": no such choice; did you mean 'edges'?"),
    "no terms": (('["edges"]', "[]"), "likelihood #2: terms = []; expected at least 1 entries"),
    "observation": (
        ("edge_threshold = 11.0", "edge_threshold = 0"),
        "likelihood #1.observation: edge_threshold = 0; expected a number",
    ),
    "unknown kind": (('kind = "diffusion"', 'kind = "difusion"'), "dynamics.kind: dynamics 'difusion' does not exist; did you mean 'diffusion'?"),
    "detectors of a body by angles": (("[kernel]", '[detectors]\nuse = ["limbs"]\n\n[kernel]'), "detectors: the body is placed by angles"),
    "detector": (
        ('name = "arm_4"', 'name = "arm_4"\nplacement = "parts"\n[detectors]\nuse = ["limb"]'),
        "detectors.use #1 = \"limb\": no such choice; did you mean 'limbs'?",
    ),
    "infinite": (("at_fps = 30", "at_fps = inf"), "dynamics: at_fps = inf; expected a finite number"),
    "not quite whole": (("particles = 12", "particles = 12.5"), "kernel: particles = 12.5; expected a whole number"),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_one_fault_is_one_sentence_that_begins_with_the_file(write, fault):
    change, part = FAULTS[fault]
    path = write(change)
    (sentence,) = sentences(path)
    assert sentence.startswith(f"{path}: ")
    assert part in sentence


def test_all_faults_are_said_at_once(write):
    path = write(*(FAULTS[fault][0] for fault in ("second likelihood", "observation", "unknown kind", "not quite whole", "body's name a number")))
    assert len(sentences(path)) == 5
