"""The bodies with hands and feet: in all else they are `deutscher_31`, and a person who stands stands on the soles."""

import dataclasses

import jax
import numpy as np
import pytest

from bayes_body.model.body.build import Shape, build_body
from bayes_body.model.body.kinematics import marker_positions
from bayes_body.model.body.placed_body import loosened
from bayes_body.model.body.solids import part_transforms
from bayes_body.model.build import build_model
from bayes_body.model.definition import load_body
from bayes_body.recording.evidence.markers import FEET
from bayes_body.recording.session.session import Subject

HEIGHT = 1.8
# The dofs of ankle and wrist, and the parts of a limb with the one that each hangs on.
BENDS = ("ankle_y", "ankle_z", "wrist_y", "wrist_x")
LIMBS = {"calf": "thigh", "foot": "calf", "forearm": "upper_arm", "hand": "forearm"}


positions, solids_of = jax.jit(marker_positions), jax.jit(part_transforms)


@pytest.fixture(scope="module")
def pair():
    return [build_body(name, load_body(name), Shape(HEIGHT)) for name in ("deutscher_31", "person_31")]


def test_dofs_limits_and_markers_are_those_of_the_body_without(pair):
    without, person = pair
    assert person.dof_names == without.dof_names and person.markers.names == without.markers.names
    low, high = (np.clip(np.asarray(limit), -1, 1) for limit in (without.skeleton.low, without.skeleton.high))
    assert np.array_equal(without.skeleton.low, person.skeleton.low) and np.array_equal(without.skeleton.high, person.skeleton.high)
    for pose in np.random.default_rng(0).uniform(low, high, (20, len(low))):
        here, there = (positions(body.skeleton, body.markers, pose) for body in pair)
        assert np.allclose(here, there, atol=1e-6)


@pytest.fixture(scope="module")
def fifteen():
    return build_body("person_40", load_body("person_40"), Shape(HEIGHT))


def test_fifteen_parts_move_as_those_of_the_body_with_stiff_hands_and_feet(pair, fifteen):
    """With the nine new angles at 0; the ends of hands and feet are markers of their own."""
    _, person = pair
    assert set(fifteen.dof_names) - set(person.dof_names) == {"thorax_x", *(f"{s}_{dof}" for s in "lr" for dof in BENDS)}
    assert fifteen.markers.names[:15] == person.markers.names
    for angles in np.random.default_rng(0).uniform(-0.5, 0.5, (20, len(person.dof_names))):
        named = dict(zip(person.dof_names, angles, strict=True))
        here, there = _markers(person, **named), _markers(fifteen, **named)
        assert np.allclose(here, there[:15], atol=1e-6)


def test_fifteen_parts_are_joined_as_in_the_paper(fifteen):
    """Sigal et al. 2011, Fig. 1: fourteen joints and thirteen pairs that must not penetrate."""
    placement = loosened(fifteen).placement
    parents = {name: placement.names[parent] for name, parent in zip(placement.names, placement.parents, strict=True) if parent >= 0}
    limbs = {f"{s}_{part}": f"{s}_{on}" for s in "lr" for part, on in LIMBS.items()}
    trunk = {"torso": "pelvis", "head": "torso", "l_thigh": "pelvis", "r_thigh": "pelvis", "l_upper_arm": "torso", "r_upper_arm": "torso"}
    assert parents == limbs | trunk and len(fifteen.topology.penetration) == 13


@pytest.fixture(scope="module")
def ankles():
    return build_body("person_35", load_body("person_35"), Shape(HEIGHT))


def test_ankles_add_four_angles_and_shoulders_are_narrower(pair, ankles):
    """With flat feet and shoulders of the same breadth the body moves as the one without ankles."""
    _, person = pair
    assert set(ankles.dof_names) - set(person.dof_names) == {f"{s}_{dof}" for s in "lr" for dof in ("ankle_y", "subtalar")}
    assert ankles.markers.names == (*person.markers.names, *FEET)
    narrow = build_body("person_31", load_body("person_31"), Shape(HEIGHT, dict.fromkeys(("l_clavicle", "r_clavicle"), 0.105 * HEIGHT)))
    for angles in np.random.default_rng(0).uniform(-0.5, 0.5, (5, len(person.dof_names))):
        named = dict(zip(person.dof_names, angles, strict=True))
        assert np.allclose(_markers(narrow, **named), _markers(ankles, **named)[:15], atol=1e-6)


@pytest.mark.parametrize(
    ("body", "angle", "marker", "direction"),
    [
        ("fifteen", "l_ankle_y", "l_toe", (0, 0, 1)),
        ("fifteen", "thorax_x", "head", (0, 1, 0)),
        ("ankles", "l_ankle_y", "l_big_toe", (0, 0, 1)),
        ("ankles", "r_ankle_y", "r_small_toe", (0, 0, 1)),
        # An inverted foot points inwards.
        ("ankles", "l_subtalar", "l_big_toe", (0, -1, 0)),
        ("ankles", "r_subtalar", "r_big_toe", (0, 1, 0)),
    ],
)
def test_where_new_joints_bend(request, body, angle, marker, direction):
    """A positive angle of the ankle points the toes up, one of the subtalar joint inwards, and one of the spine bends it to the left."""
    person = request.getfixturevalue(body)
    step = (_markers(person, **{angle: 0.3}) - _markers(person))[person.markers.names.index(marker)]
    assert step @ np.array(direction) > 0.9 * np.linalg.norm(step) > 0.04


def test_a_foot_turns_about_the_axis_of_opensim(ankles):
    """The subtalar axis of gait2392 (Delp et al. 1990): forward, up and to the right; and the sole of an inverted foot faces inwards."""
    for side, inwards in (("l", -1), ("r", 1)):
        axis = np.array([0.78718, inwards * 0.120949, 0.604747])
        ankle, *feet = (ankles.markers.names.index(f"{side}_{name}") for name in ("ankle", "heel", "big_toe", "small_toe"))
        before, after = (_markers(ankles, **{f"{side}_subtalar": angle}) for angle in (0.0, 0.3))
        from_axis = before[feet] - before[ankle]
        step = after[feet] - before[feet]
        # A rotation moves nothing along its axis, and by an angle about it: 2 sin(angle / 2) times the distance from it.
        away = from_axis - np.outer(from_axis @ axis, axis)
        assert np.abs(step @ axis).max() < 3e-4
        np.testing.assert_allclose(np.linalg.norm(step, axis=1), 2 * np.sin(0.15) * np.linalg.norm(away, axis=1), rtol=0.01)
        rise = step[1, 2] - step[2, 2]
        assert rise > 0.01, "the inner edge of an inverted foot is the higher one"


def _markers(body, **angles):
    return np.asarray(positions(body.skeleton, body.markers, _pose(body, **({"root_z": 0.0} | angles))))


def _pose(body, **angles):
    # Hips at 0.530 of the height, Winter's figure.
    values = {"root_z": 0.53 * HEIGHT, **angles}
    return np.float32([values.get(name, 0.0) for name in body.dof_names])


@pytest.mark.parametrize("name", ["person_31", "person_35", "person_40"])
def test_who_stands_stands_on_flat_soles(pair, ankles, fifteen, name):
    person = {"person_31": pair[1], "person_35": ankles, "person_40": fifteen}[name]
    solids, radii = solids_of(person, _pose(person)), np.asarray(person.radii)
    for side in "lr":
        foot = person.topology.names.index(f"{side}_foot")
        heel, along = np.asarray(solids.origin)[foot], np.asarray(solids.rotation)[foot, :, 2]
        assert np.isclose(along[2], 0, atol=1e-6)
        assert np.isclose(heel[2], radii[foot, 0], atol=0.002)


def test_toes_point_to_where_knees_do_not_bend(pair):
    _, person = pair
    straight, bent = (_markers(person, root_z=0.53 * HEIGHT, l_knee=angle) for angle in (0.0, -1.0))
    ankle = person.markers.names.index("l_ankle")
    backward = (bent - straight)[ankle] * [1, 1, 0]
    foot = person.topology.names.index("l_foot")
    toes = np.asarray(solids_of(person, _pose(person)).rotation)[foot, :, 2]
    assert toes @ backward / np.linalg.norm(backward) < -0.99


def test_a_subject_measured_for_the_body_without_is_taken(textured_session):
    subject = Subject(body="deutscher_31", height_m=HEIGHT, lengths_m={"l_thigh": 0.5}, motion_sd={"root_x": 0.02})
    model = build_model("silhouettes", dataclasses.replace(textured_session, subject=subject))
    assert model.body.name == "person_31"
    assert np.isclose(model.body.lengths[model.body.topology.names.index("l_thigh")], 0.5)
    assert np.isclose(model.body.lengths[model.body.topology.names.index("l_foot")], 0.112 * HEIGHT)
    # Measures of a body of another chart are not.
    other = build_model("silhouettes", dataclasses.replace(textured_session, subject=dataclasses.replace(subject, body="arm_4")))
    assert np.isclose(other.body.lengths[other.body.topology.names.index("l_thigh")], 0.245 * HEIGHT)
