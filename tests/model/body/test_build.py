"""A subject's measures become a body: what is given is taken, what is missing follows from the height."""

import tomllib

import jax
import numpy as np
import pytest

from bayes_body.base.errors import InputError
from bayes_body.base.files.shipped import definitions_folder
from bayes_body.model.body.build import Shape, build_body
from bayes_body.model.body.kinematics import marker_positions
from bayes_body.model.body.schema import BodySchema
from bayes_body.model.body.solids import Body
from bayes_body.model.definition import load_body

NAME = "deutscher_31"


@pytest.fixture(scope="module")
def schema() -> BodySchema:
    return load_body(NAME)


positions = jax.jit(marker_positions)


def length(body: Body, part: str) -> float:
    return float(np.asarray(body.lengths)[body.topology.names.index(part)])


def knee(body: Body) -> np.ndarray:
    return np.asarray(body.skeleton.offsets)[body.skeleton.topology.joint_names.index("l_knee")]


def test_lengths_are_shares_of_the_height(schema):
    body = build_body(NAME, schema, Shape(height_m=1.8))
    for part in schema.parts:
        assert length(body, part.name) == pytest.approx(1.8 * schema.lengths_of_height[part.length], rel=1e-6)
        radii = np.asarray(body.radii)[body.topology.names.index(part.name)]
        np.testing.assert_allclose(radii, 1.8 * np.array(part.radius_of_height), rtol=1e-6)
    np.testing.assert_allclose(knee(body), [0, 0, 1.8 * schema.lengths_of_height["l_thigh"]], rtol=1e-6)


def test_without_a_height_the_files_own_is_taken(schema):
    body = build_body(NAME, schema)
    assert length(body, "torso") == pytest.approx(schema.height_m * schema.lengths_of_height["torso"], rel=1e-6)


def test_a_named_length_is_taken_for_all_that_it_measures(schema):
    plain, body = build_body(NAME, schema, Shape(height_m=1.8)), build_body(NAME, schema, Shape(1.8, {"l_thigh": 0.5}))
    assert length(body, "l_thigh") == 0.5
    np.testing.assert_allclose(knee(body), [0, 0, 0.5])
    others = [part.name for part in schema.parts if part.name != "l_thigh"]
    assert [length(body, part) for part in others] == [length(plain, part) for part in others]


def test_radii_and_sections_of_a_part(schema):
    plain, body = build_body(NAME, schema), build_body(NAME, schema, Shape(radii_m={"head": (0.1, 0.12)}, sections={"head": (0.7, 0.9)}))
    head = body.topology.names.index("head")
    np.testing.assert_allclose(body.radii[head], [0.1, 0.12], rtol=1e-6)
    np.testing.assert_allclose(body.sections[head], [0.7, 0.9], rtol=1e-6)
    others = np.arange(len(body.topology.names)) != head
    np.testing.assert_array_equal(body.radii[others], plain.radii[others])
    np.testing.assert_array_equal(body.sections[others], plain.sections[others])
    np.testing.assert_array_equal(body.outline_radii, body.radii)


def test_nobody_is_thicker_than_they_look(schema):
    plain, body = build_body(NAME, schema), build_body(NAME, schema, Shape(outline_radii_m={"head": (0.3, 0.01)}))
    head = body.topology.names.index("head")
    np.testing.assert_allclose(body.outline_radii[head], [0.3, 0.01], rtol=1e-6)
    np.testing.assert_allclose(body.radii[head], [plain.radii[head, 0], 0.01], rtol=1e-6)


def test_limits_are_radians_and_may_be_missing(schema):
    body = build_body(NAME, schema)
    limits = {name: (float(a), float(b)) for name, a, b in zip(body.dof_names, body.skeleton.low, body.skeleton.high, strict=True)}
    assert limits["root_x"] == limits["root_yaw"] == (-np.inf, np.inf)
    assert limits["l_knee"] == pytest.approx(np.radians([-155, 10]), rel=1e-6)


@pytest.mark.parametrize(
    ("shape", "field", "remedy"),
    [
        (Shape(lengths_m={"l_thig": 0.5}), "lengths_m.l_thig", "did you mean 'l_thigh'?"),
        (Shape(radii_m={"haed": (0.1, 0.1)}), "radii_m.haed", "did you mean 'head'?"),
        (Shape(sections={"torsoo": (1.0, 1.0)}), "sections.torsoo", "did you mean 'torso'?"),
        # A length of the file that is no part's name.
        (Shape(radii_m={"l_pelvis": (0.1, 0.1)}), "radii_m.l_pelvis", "known: head, l_calf, "),
    ],
)
def test_a_name_that_the_body_does_not_have(schema, shape, field, remedy):
    with pytest.raises(InputError) as error:
        build_body(NAME, schema, shape)
    assert str(error.value).startswith(f"subject.{field}: no such name; expected a name of the body '{NAME}'; ")
    assert remedy in str(error.value)


@pytest.mark.parametrize(
    ("table", "change", "sentence"),
    [
        ("joint", {"parent": "l_hipp"}, "joint 'l_knee': parent 'l_hipp' is not a joint; did you mean 'l_hip'?"),
        ("joint", {"offset": {"z": "-l_tigh"}}, "joint 'l_knee': offset z = '-l_tigh' is not a length; did you mean 'l_thigh'?"),
        ("joint", {"name": "l_hip"}, "joint 'l_hip' is defined 2 times; give each joint a unique name"),
        ("part", {"joint": "l_nee"}, "part 'l_calf': joint 'l_nee' does not exist; did you mean 'l_knee'?"),
        ("part", {"length": "l_calv"}, "part 'l_calf': length 'l_calv' is not in lengths_of_height; did you mean 'l_calf'?"),
    ],
)
def test_names_in_a_body_file_that_mean_nothing(table, change, sentence):
    document = tomllib.loads((definitions_folder() / "bodies" / f"{NAME}.toml").read_text())
    (target,) = [entry for entry in document[table] if entry["name"] == {"joint": "l_knee", "part": "l_calf"}[table]]
    target |= change
    with pytest.raises(ValueError) as error:
        BodySchema.model_validate(document)
    assert sentence in str(error.value)


def test_joints_in_a_circle():
    document = tomllib.loads((definitions_folder() / "bodies" / f"{NAME}.toml").read_text())
    (root,) = [joint for joint in document["joint"] if joint["name"] == "root"]
    root["parent"] = "l_knee"
    with pytest.raises(ValueError, match=r"form a cycle of parents; one of them must have the parent 'world'") as error:
        BodySchema.model_validate(document)
    assert {"root", "l_hip", "l_knee"} <= set(str(error.value).split("joints ")[1].split(" hang")[0].split(" -> "))


@pytest.mark.parametrize(
    "fixed", [["l_hip_x"], ["l_hip_y"], ["l_hip_z", "l_knee"], ["root_z"], ["root_y", "root_roll", "l_hip_y", "l_hip_x", "l_hip_z"]], ids="+".join
)
def test_a_dof_whose_limits_are_equal_is_a_constant(schema, fixed):
    values = {"l_hip_x": 20.0, "l_hip_y": -35.0, "l_hip_z": 10.0, "l_knee": -50.0, "root_z": 0.9, "root_y": -0.3, "root_roll": 15.0}
    table = tomllib.loads((definitions_folder() / "bodies" / f"{NAME}.toml").read_text(encoding="utf-8"))
    for joint in table["joint"]:
        for dof in joint.get("dofs", []):
            if dof["name"] in fixed:
                unit = "m" if dof["axis"].startswith("t") else "deg"
                dof |= {f"low_{unit}": values[dof["name"]], f"high_{unit}": values[dof["name"]]}
    whole, less = build_body(NAME, schema), build_body(NAME, BodySchema.model_validate(table))
    assert set(whole.dof_names) - set(less.dof_names) == set(fixed)
    rng = np.random.default_rng(0)
    pose = dict(zip(whole.dof_names, rng.uniform(-0.4, 0.4, len(whole.dof_names)), strict=True))
    pose |= {name: values[name] if name.startswith("root") and name != "root_roll" else np.radians(values[name]) for name in fixed}
    there, here = (positions(body.skeleton, body.markers, np.float32([pose[name] for name in body.dof_names])) for body in (whole, less))
    np.testing.assert_allclose(here, there, atol=2e-6)
