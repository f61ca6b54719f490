"""Parts of the first pose: points of a body, lengths, measurements, starts."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from bayes_body.base.errors import FaultyFileError, InputError
from bayes_body.base.geometry.camera import project
from bayes_body.initial.fitting.measurements import read_measurements, unused_names
from bayes_body.initial.fitting.points import SPREAD, as_markers, body_points, scaled
from bayes_body.initial.fitting.problem import build_problem
from bayes_body.initial.fitting.starts import HEADINGS, candidates
from bayes_body.model.body.build import Shape, build_body
from bayes_body.model.body.kinematics import marker_positions
from bayes_body.model.body.lengths import fields, fixed, scaling
from bayes_body.model.build import build_model
from bayes_body.model.definition import load_body

positions = jax.jit(marker_positions)


def test_the_nose_is_in_front_and_ears_are_on_their_sides(model):
    points = body_points(model.body)
    zero = np.zeros(len(model.body.dof_names), np.float32)
    places = dict(zip(points.names, np.asarray(positions(model.body.skeleton, as_markers(model.body, points), zero)), strict=True))
    # With all angles 0 the body faces along +x and its left is +y.
    assert places["nose"][0] > places["l_eye"][0] > places["l_ear"][0] > 0
    assert places["l_ear"][1] > places["l_eye"][1] > 0 > places["r_eye"][1] > places["r_ear"][1]
    assert places["head"][2] > places["l_eye"][2] > places["nose"][2] > places["thorax"][2]


def test_other_words_and_bodies_without_a_head(model):
    points = body_points(model.body)
    assert points.index("neck") == points.index("thorax")
    assert points.index("l_heel") is None
    arm = build_body("arm", load_body("arm_4"))
    assert body_points(arm).names == arm.markers.names
    assert as_markers(arm, body_points(arm)) is arm.markers


def test_a_scaled_body_is_the_body_built_with_those_lengths(body_schema):
    body = build_body("one", body_schema, Shape(1.8, {"l_thigh": 0.5}))
    change = scaling(body, body_schema)
    z = jnp.asarray(np.random.default_rng(0).normal(size=change.groups.shape[1]))
    grown = np.exp(SPREAD * np.asarray(change.groups) @ np.asarray(z))
    usual = {name: share * 1.8 for name, share in body_schema.lengths_of_height.items()} | {"l_thigh": 0.5}
    lengths = {name: value * factor for (name, value), factor in zip(usual.items(), grown.tolist(), strict=True)}
    expected = build_body("one", body_schema, Shape(1.8, lengths))
    for got, wanted in zip(jax.jit(lambda *given: fields(scaled(*given)))(body, change, z), fields(expected), strict=True):
        assert np.allclose(got, wanted, atol=1e-5)
    assert lengths["l_calf"] == pytest.approx(lengths["r_calf"])
    assert lengths["l_thigh"] / 0.5 == pytest.approx(lengths["r_thigh"] / usual["r_thigh"])


def test_fixed_lengths_are_no_parameters(model):
    assert scaled(model.body, fixed(model.body), jnp.zeros(0)) is model.body


def test_rays_are_what_the_camera_projects_to_the_pixels(scene, model, walker, seen):
    rng = np.random.default_rng(1)
    session = scene(1)
    person = walker(rng)
    keypoints, _ = seen(session, person, rng, noise_px=0.0)
    measurements = read_measurements(dataclasses.replace(session, initial_keypoints=keypoints), body_points(model.body))
    spec = session.views[0].camera
    given = measurements.pixel_weights[0] > 0
    ahead = np.concatenate([measurements.rays[0], np.ones((len(given), 1))], axis=1)
    places = (4 * ahead - spec.translation_m) @ spec.rotation
    pixels, _ = jax.jit(project)(jax.tree.map(lambda leaf: np.asarray(leaf)[0], model.rig), places.astype(np.float32))
    assert np.allclose(np.asarray(pixels)[given], measurements.pixels[0][given], atol=0.05)


KEYPOINTS = dict.fromkeys(("l_hip", "r_hip", "l_knee", "r_knee", "l_ankle"), (500.0, 900.0, 0.5))


@pytest.mark.parametrize(
    ("known", "said"),
    [
        ({"initial_markers": {"l_hip": (float("nan"), 0.0, 0.0)}}, "markers_m.l_hip: .*nan.*; expected three numbers"),
        (
            {"initial_keypoints": {"cam0": KEYPOINTS | {"nose": (5000.0, 20.0, 0.5)}}},
            "cam0.nose: .5000, 20. lies outside its image of 1088 x 1920 px",
        ),
        ({"initial_keypoints": {"cam0": KEYPOINTS | {"nose": (50.0, 20.0, 1.5)}}}, "cam0.nose: confidence 1.5; expected a number between 0 and 1"),
        ({"initial_keypoints": {"cam9": KEYPOINTS}}, "cam9: no camera of that name; expected one of cam0"),
        ({"initial_keypoints": {"cam0": dict.fromkeys(KEYPOINTS, (0.0, 0.0, 0.0))}}, "every confidence is 0"),
        (
            {"initial_keypoints": {"cam0": {"l_hip": (500.0, 900.0, 0.5), "nose": (500.0, 300.0, 0.9)}}},
            "1 points of the body .l_hip.; expected at least 4",
        ),
        ({"initial_markers": {"left foot": (0.0, 0.0, 0.0)}}, "0 points of the body .none.; expected at least 4"),
    ],
)
def test_what_cannot_be_used_is_said(scene, model, known, said):
    with pytest.raises(InputError, match=said):
        read_measurements(scene(1, **known), body_points(model.body))


def test_names_of_no_point_of_the_body_are_left_out_and_said(scene, model):
    points = body_points(model.body)
    known = dict.fromkeys(("l_hip", "r_hip", "l_knee", "r_knee", "r_big_toe", "l_sholder"), (0.0, 0.0, 1.0))
    session = scene(1, initial_markers=known)
    detectors, misspelt = unused_names(session, points)
    assert detectors == "this body has no points r_big_toe; the pose was fitted to the other points"
    assert misspelt == "'l_sholder' is not a point of this body and was not used; did you mean 'l_shoulder'?"
    assert np.asarray(read_measurements(session, points).marker_weights).sum() == 4


def test_a_camera_that_sees_nothing_is_said(scene, model):
    session = scene(1, initial_keypoints={"cam0": KEYPOINTS})
    view = session.views[0]
    flat = dataclasses.replace(view, camera=dataclasses.replace(view.camera, rotation=np.zeros((3, 3))))
    with pytest.raises(FaultyFileError, match="camera 'cam0': it maps space to a line"):
        read_measurements(dataclasses.replace(session, views=(flat,)), body_points(model.body))


@pytest.mark.long
@pytest.mark.parametrize("up", ["x", "y", "z"])
def test_there_are_upright_starts_of_every_heading(scene, model, walker, seen, up):
    rng = np.random.default_rng(2)
    session = scene(2, up)
    session = dataclasses.replace(session, initial_keypoints=seen(session, walker(rng), rng)[0])
    points = body_points(model.body)
    found = candidates(
        build_problem(build_model(model.definition, session), session, points, read_measurements(session, points)), "xyz".index(up), jax.random.key(0)
    )
    assert set(np.asarray(found.heading)[np.asarray(found.upright)].tolist()) == set(range(HEADINGS))
    # Moved to where the person is, some 4 m from the cameras and 0.9 m high.
    best = found.poses[jnp.argmin(found.scores)]
    assert np.allclose(best[:3], 0.9 * np.eye(3)["xyz".index(up)], atol=0.4)
