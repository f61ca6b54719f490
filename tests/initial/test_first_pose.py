"""The first pose: a kinematic identity, people of other lengths, wrong detections, one camera, three ways to be up, lengths."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest

from bayes_body.base.errors import InputError
from bayes_body.initial import apply_first_pose, first_pose, first_pose_source, stored
from bayes_body.model.body.kinematics import marker_positions
from bayes_body.model.build import build_model

# Fits and replications run for longer than they compile.
pytestmark = pytest.mark.usefixtures("optimised")


def _markers(person):
    return {name: tuple(float(x) for x in place) for name, place in person.places.items()}


def _places(model, pose):
    """The markers of a model's body in a pose."""
    places = np.asarray(model.markers(pose)).astype(float).tolist()
    return {name: tuple(place) for name, place in zip(model.body.markers.names, places, strict=True)}


def _with(session, **changes):
    return dataclasses.replace(session, **changes)


def _median(errors):
    return float(np.median(list(errors.values())))


def test_angles_are_taken_as_they_are(scene, model):
    session = scene(1, initial={"l_knee": -0.7, "root_z": 0.9})
    model = build_model(model.definition, session)
    found = first_pose(model, session)
    assert (found.pose == model.initial["pose"]).all()
    assert found.remarks == ()
    assert found.source == "given"
    assert (apply_first_pose(model, session, found).initial["pose"] == model.initial["pose"]).all()


PLACE = {"root_x": 0.0}


@pytest.mark.parametrize(
    ("changes", "source"),
    [
        ({"initial": PLACE}, "given"),
        ({"initial": PLACE, "fit_lengths": True}, "given"),
        ({"initial": PLACE, "fit_outline": True}, "fitted"),
        ({"initial_markers": {"pelvis": (0.0, 0.0, 1.0)}}, "fitted"),
        ({"initial": {"l_knee": -0.7}, "fit_outline": True}, "searched"),
        ({}, "searched"),
    ],
)
def test_a_first_pose_has_a_source(scene, model, changes, source):
    assert first_pose_source(model, scene(1, **changes)) == source
    assert first_pose_source(model, scene(1, **changes), {"pose": {}}) == "stored"


def test_a_stored_pose_is_used_unchanged(scene, model):
    session = scene(1, initial=PLACE)
    table = stored(model, first_pose(model, session))
    restored = first_pose(model, session, table=table)
    assert restored.source == "stored" and (restored.pose == model.first_pose).all()
    with pytest.raises(InputError, match=r"run\.toml: pose: dofs of another body"):
        first_pose(model, session, table={}, table_name="run.toml")


def _random_poses(skeleton, rng, count):
    low, high = np.asarray(skeleton.low), np.asarray(skeleton.high)
    bounded = np.isfinite(low)
    u = rng.uniform(0.05, 0.95, (count, low.size))
    return np.where(bounded, np.where(bounded, low, 0) + u * np.where(bounded, high - low, 0), rng.normal(size=u.shape))


def _recovered(model, session, pose):
    body = model.body
    places = np.asarray(marker_positions(body.skeleton, body.markers, jnp.asarray(pose, body.lengths.dtype)))
    known = {name: tuple(place) for name, place in zip(body.markers.names, places.astype(float).tolist(), strict=True)}
    found = first_pose(model, _with(session, initial_markers=known))
    low, high = body.skeleton.low, body.skeleton.high
    assert ((found.pose >= low) & (found.pose <= high)).all()
    return max(found.marker_residuals_m.values())


@pytest.mark.slow
def test_markers_of_the_very_body_are_met(scene, model):
    worst = [_recovered(model, scene(1), pose) for pose in _random_poses(model.body.skeleton, np.random.default_rng(1), 3)]
    assert np.median(worst) < 0.003
    assert max(worst) < 0.03


@pytest.mark.long
def test_nearly_all_poses_within_the_limits_are_found(scene, model):
    worst = [_recovered(model, scene(1), pose) for pose in _random_poses(model.body.skeleton, np.random.default_rng(2), 100)]
    assert np.mean(np.array(worst) < 0.01) >= 0.95


@pytest.mark.long
def test_markers_of_another_person_one_of_them_wrong(scene, model, walker, errors_m):
    rng = np.random.default_rng(3)
    for _ in range(4):
        person = walker(rng)
        known = {name: place for name, place in _markers(person).items() if name in model.body.markers.names}
        known["l_wrist"] = (known["l_wrist"][0], known["l_wrist"][1], known["l_wrist"][2] + 1.5)
        found = first_pose(model, scene(1, initial_markers=known))
        errors = errors_m(found.pose, person)
        # Segments differ by some ten percent, 5 cm of a torso.
        assert _median(errors) < 0.06
        assert found.outliers == ((None, "l_wrist"),)
        assert "marker l_wrist is" in found.remarks[0]


@pytest.mark.long
def test_four_cameras_with_a_fifth_of_all_keypoints_wrong(scene, model, walker, seen, errors_m):
    rng = np.random.default_rng(4)
    medians, found_wrong, taken_for_wrong = [], [], []
    for _ in range(4):
        person, session = walker(rng), scene(4)
        keypoints, wrong = seen(session, person, rng, outliers=0.2)
        model_of = build_model(model.definition, session)
        found = first_pose(model_of, _with(session, initial_keypoints=keypoints))
        medians.append(_median(errors_m(found.pose, person)))
        gross = {point for point in wrong if found.keypoint_residuals_px[point[0]][point[1]] > 100}
        found_wrong.append(len(gross & set(found.outliers)) / len(gross))
        taken_for_wrong.append(len(set(found.outliers) - wrong))
    assert max(medians) < 0.04
    assert min(found_wrong) == 1.0
    # Of 72.
    assert max(taken_for_wrong) <= 3


def _forward(places):
    across = (places["l_shoulder"] - places["r_shoulder"] + places["l_hip"] - places["r_hip"])[:2]
    return np.array([across[1], -across[0]]) / np.linalg.norm(across)


@pytest.mark.long
def test_one_camera_tells_where_a_person_faces_and_mostly_what_is_nearer(scene, model, walker, seen):
    rng = np.random.default_rng(5)
    session = scene(1)
    depth = session.views[0].camera.rotation[2]
    facing, order = [], []
    for _ in range(10):
        person = walker(rng)
        keypoints, _ = seen(session, person, rng)
        found = first_pose(model, _with(session, initial_keypoints=keypoints))
        places = dict(zip(model.body.markers.names, np.asarray(model.markers(found.pose)), strict=True))
        facing.append(_forward(places) @ _forward(person.places) > np.cos(np.pi / 4))
        for a, b in (("l_wrist", "l_shoulder"), ("r_wrist", "r_shoulder"), ("l_ankle", "l_hip"), ("r_ankle", "r_hip"), ("l_ankle", "r_ankle")):
            true = (person.places[a] - person.places[b]) @ depth
            if abs(true) > 0.15:
                order.append(np.sign(true) == np.sign((places[a] - places[b]) @ depth))
    assert np.mean(facing) >= 0.8
    assert len(order) > 10
    assert np.mean(order) >= 0.6


@pytest.mark.long
@pytest.mark.parametrize("up", ["x", "y"])
def test_a_person_stands_in_a_world_whose_other_axis_is_up(scene, model, walker, seen, errors_m, up):
    rng = np.random.default_rng(6)
    for _ in range(3):
        person, session = walker(rng), scene(4, up)
        keypoints, _ = seen(session, person, rng)
        found = first_pose(build_model(model.definition, session), _with(session, initial_keypoints=keypoints))
        assert _median(errors_m(found.pose, person, up)) < 0.04


@pytest.mark.long
def test_lengths_are_fitted_on_request(scene, model, walker, seen, errors_m):
    rng = np.random.default_rng(7)
    before, after = [], []
    for _ in range(4):
        person = walker(rng, spread=0.12)
        session = scene(4, fit_lengths=True)
        keypoints, _ = seen(session, person, rng)
        session = _with(session, initial_keypoints=keypoints)
        usual = build_model(model.definition, session)
        found = first_pose(usual, session)
        fitted = apply_first_pose(usual, session, found)
        assert found.lengths_m["l_thigh"] == pytest.approx(found.lengths_m["r_thigh"])
        assert errors_m(fitted.initial["pose"], person, of=fitted)["l_ankle"] < 0.1
        true = np.array([person.lengths[name] for name in usual.body.topology.names])
        before.append(np.log(usual.body.lengths / true))
        after.append(np.log(fitted.body.lengths / true))
        # Every factor looks at the new body.
        assert (fitted.factors[0].log_potential.body.lengths == fitted.body.lengths).all()
    assert np.std(after) < 0.6 * np.std(before)
    assert np.abs(np.mean(after)) < 0.03


def test_lengths_from_one_camera_are_refused(scene, model, walker, seen):
    rng = np.random.default_rng(8)
    session = scene(1, fit_lengths=True)
    keypoints, _ = seen(session, walker(rng), rng)
    with pytest.raises(InputError, match=r"fit_lengths: true, with keypoints from 1 camera and no markers; expected .* two cameras"):
        first_pose(model, _with(session, initial_keypoints=keypoints))
    with pytest.raises(InputError, match="fit_lengths: true, with keypoints from 0 cameras"):
        first_pose(model, session, "fitted")


@pytest.mark.slow
def test_given_angles_draw_the_fit(scene, model, walker):
    person = walker(np.random.default_rng(9))
    known = {name: place for name, place in _markers(person).items() if not name.startswith("l_") and name in model.body.markers.names}
    session = scene(1, initial_markers=known, initial={"l_knee": -1.1})
    found = first_pose(build_model(model.definition, session), session)
    assert found.pose[model.body.dof_names.index("l_knee")] == pytest.approx(-1.1, abs=0.02)


@pytest.mark.slow
def test_a_body_of_three_markers(scene):
    session = scene(1)
    arm = build_model("arm", session)
    true = jnp.asarray([-0.6, -0.9, 0.3, -1.0])
    found = first_pose(arm, _with(session, initial_markers=_places(arm, true)))
    assert max(found.marker_residuals_m.values()) < 0.003
    assert np.allclose(found.pose, true, atol=0.05)


@pytest.mark.long
def test_a_camera_that_fits_badly_is_said(scene, model, walker, seen):
    rng = np.random.default_rng(10)
    session = scene(4)
    keypoints, _ = seen(session, walker(rng), rng)
    shifted = {name: (u, v + 250, confidence) for name, (u, v, confidence) in keypoints["cam2"].items()}
    found = first_pose(build_model(model.definition, session), _with(session, initial_keypoints=keypoints | {"cam2": shifted}))
    assert len(found.remarks) == 1
    assert "camera cam2's keypoints fit badly, median 2" in found.remarks[0]


@pytest.mark.slow
def test_unknown_names_are_left_out_and_said(scene):
    arm = build_model("arm", scene(1))
    known = _places(arm, jnp.asarray([-0.6, -0.9, 0.3, -1.0])) | {"r_big_toe": (0.0, 0.0, 0.0), "l_sholder": (0.0, 0.0, 0.0)}
    found = first_pose(arm, scene(1, initial_markers=known))
    assert found.remarks[0] == "this body has no points r_big_toe; the pose was fitted to the other points"
    assert "'l_sholder' is not a point of this body and was not used; did you mean 'l_shoulder'?" in found.remarks[1]
    assert "r_big_toe" not in found.marker_residuals_m
