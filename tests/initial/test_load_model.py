"""`bb.load_model`: one call that gives a model which starts from the session's first pose."""

import dataclasses
import re

import numpy as np
import pytest

import bayes_body as bb
from bayes_body.base.errors import InputError
from bayes_body.initial import first_pose
from bayes_body.model.build import build_model
from bayes_body.recording.readers.keypoints.series import KeypointSeries, write_series

# Fits run for longer than they compile.
pytestmark = pytest.mark.usefixtures("optimised")


@pytest.fixture
def reports():
    return []


@pytest.fixture(scope="module")
def person(walker):
    return walker(np.random.default_rng(3))


def _markers(person):
    return {name: tuple(float(x) for x in place) for name, place in person.places.items()}


def test_angles_are_taken_as_they_are_and_nothing_is_fitted(scene, reports):
    session = scene(1, initial={"l_knee": -0.7, "root_z": 0.9})
    model = bb.load_model("deutscher_2005", session, reports.append)
    assert (model.initial["pose"] == build_model("deutscher_2005", session).initial["pose"]).all() and reports == []


@pytest.mark.slow
def test_markers_are_fitted_and_reported(scene, person, reports):
    session = scene(1, initial_markers=_markers(person))
    model, plain = bb.load_model("deutscher_2005", session, reports.append), build_model("deutscher_2005", session)
    assert re.fullmatch(r"first pose: fitted in \d+ s, \d+ mm off the markers \(median\)", reports[0])
    np.testing.assert_array_equal(model.initial["pose"], first_pose(plain, session).pose)
    assert np.abs(np.asarray(model.initial["pose"] - plain.initial["pose"])).max() > 0.1


@pytest.mark.slow
def test_the_keypoints_of_frame_0_are_a_first_pose_where_there_is_no_other(scene, person, seen, tmp_path, reports):
    session = scene(2)
    keypoints, _ = seen(session, person, np.random.default_rng(4))
    views = []
    for view in session.views:
        named = keypoints[view.camera.name]
        write_series(tmp_path / f"{view.camera.name}.npz", KeypointSeries(np.array([list(named.values())]), tuple(named), 0))
        views.append(dataclasses.replace(view, keypoints=str(tmp_path / f"{view.camera.name}.npz")))
    model = bb.load_model("deutscher_2005", dataclasses.replace(session, views=tuple(views)), reports.append)
    assert "px off the keypoints (median)" in reports[0]
    off = np.asarray(model.markers(model.initial["pose"]))[model.body.markers.names.index("pelvis")] - person.places["pelvis"]
    assert np.linalg.norm(off) < 0.2


@pytest.mark.parametrize("initial", [{}, {"l_knee": -0.7}], ids=["nothing", "a knee only"])
def test_a_session_that_does_not_say_where_the_body_is_is_refused(scene, initial):
    said = r"session\.toml: initial: no first pose, and no silhouettes .*; the body 'deutscher_31' would start at .*; expected .*--keypoints"
    with pytest.raises(InputError, match=said):
        bb.load_model("deutscher_2005", scene(1, initial=initial))


def test_a_body_on_a_fixed_base_needs_no_first_pose(textured_session, reports):
    model = bb.load_model("arm", textured_session, reports.append)
    assert (model.initial["pose"] == build_model("arm", textured_session).initial["pose"]).all() and reports == []
