"""The body with hands and feet: in all else it is `deutscher_31`, and a person who stands stands on the soles."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest

from bayes_body.body.build import Shape, build_body
from bayes_body.body.kinematics import marker_positions
from bayes_body.body.solids import part_transforms
from bayes_body.model.build import build_model
from bayes_body.model.definition import load_body
from bayes_body.session.session import Subject

HEIGHT = 1.8


@pytest.fixture(scope="module")
def pair():
    return [build_body(name, load_body(name), Shape(HEIGHT)) for name in ("deutscher_31", "person_31")]


def test_dofs_limits_and_markers_are_those_of_the_body_without(pair):
    without, person = pair
    assert person.dof_names == without.dof_names and person.markers.names == without.markers.names
    low, high = (np.clip(np.asarray(limit), -1, 1) for limit in (without.skeleton.low, without.skeleton.high))
    assert np.array_equal(without.skeleton.low, person.skeleton.low) and np.array_equal(without.skeleton.high, person.skeleton.high)
    for pose in np.random.default_rng(0).uniform(low, high, (20, len(low))):
        here, there = (marker_positions(body.skeleton, body.markers, jnp.asarray(pose)) for body in pair)
        assert np.allclose(here, there, atol=1e-6)


def _pose(body, **angles):
    # Hips at 0.530 of the height, Winter's figure.
    values = {"root_z": 0.53 * HEIGHT, **angles}
    return jnp.asarray([values.get(name, 0.0) for name in body.dof_names])


def test_who_stands_stands_on_flat_soles(pair):
    _, person = pair
    frames = part_transforms(person, _pose(person))
    for side in "lr":
        foot = person.topology.names.index(f"{side}_foot")
        heel, along = np.asarray(frames.origin)[foot], np.asarray(frames.z)[foot]
        assert np.isclose(along[2], 0, atol=1e-6)
        assert np.isclose(heel[2], float(person.radii[foot, 0]), atol=0.002)


def test_toes_point_to_where_knees_do_not_bend(pair):
    _, person = pair
    straight, bent = (marker_positions(person.skeleton, person.markers, _pose(person, l_knee=angle)) for angle in (0.0, -1.0))
    ankle = person.markers.names.index("l_ankle")
    backward = np.asarray(bent - straight)[ankle] * [1, 1, 0]
    foot = person.topology.names.index("l_foot")
    toes = np.asarray(part_transforms(person, _pose(person)).z)[foot]
    assert toes @ backward / np.linalg.norm(backward) < -0.99


def test_a_subject_measured_for_the_body_without_is_taken(textured_session):
    subject = Subject(body="deutscher_31", height_m=HEIGHT, lengths_m={"l_thigh": 0.5}, motion_sd={"root_x": 0.02})
    model = build_model("tempered_smc", dataclasses.replace(textured_session, subject=subject))
    assert model.body.name == "person_31"
    assert np.isclose(model.body.lengths[model.body.topology.names.index("l_thigh")], 0.5)
    assert np.isclose(model.body.lengths[model.body.topology.names.index("l_foot")], 0.112 * HEIGHT)
    # Measures of a body of another chart are not.
    other = build_model("tempered_smc", dataclasses.replace(textured_session, subject=dataclasses.replace(subject, body="arm_4")))
    assert np.isclose(other.body.lengths[other.body.topology.names.index("l_thigh")], 0.245 * HEIGHT)
