"""A camera that is carried around the person: its session says where it is in each frame, and the model follows."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from workshop.simulation.walker import walker

from bayes_body.base.files.shipped import definitions_folder
from bayes_body.base.geometry.camera import project
from bayes_body.model.build import build_model
from bayes_body.recording.observation.frames import read_frame
from bayes_body.recording.readers.camera_path import cameras_at
from bayes_body.recording.readers.check import check_session
from bayes_body.recording.readers.rig import read_rig
from bayes_body.recording.readers.truth import read_truth
from bayes_body.results.metrics.fit import seen_in
from bayes_body.workshop.simulation.options import Options
from bayes_body.workshop.simulation.person import build_person
from bayes_body.workshop.simulation.session import simulate
from bayes_body.workshop.simulation.staging import centred

FRAMES = 75


@pytest.fixture(scope="module")
def carried(tmp_path_factory):
    rig = read_rig(definitions_folder() / "rigs" / "moving_1.toml")
    options = Options(clutter=0.0, noise=0.0)
    session, _ = simulate(centred(walker(FRAMES), rig.aim_m), rig, build_person(3, 1.75), options, tmp_path_factory.mktemp("carried") / "session")
    assert check_session(session) == [] and session.moves
    return session


def hits(session, cameras, index) -> float:
    """The share of the true markers of a frame that lie on the person as these cameras stand."""
    truth = jnp.asarray(read_truth(session.truth_path, session.frames)[index])
    model = build_model("deutscher_2005", replace(session, initial_keypoints={})).at(cameras)
    (mask,) = read_frame(session, index).masks
    pixels, _ = project(jax.tree.map(lambda leaf: leaf[0], model.rig), truth)
    columns, rows = np.round(np.asarray(pixels)).astype(int).T
    inside = (columns >= 0) & (columns < mask.shape[1]) & (rows >= 0) & (rows < mask.shape[0])
    return float(np.mean([here and bool(mask[r, c]) for here, r, c in zip(inside, rows, columns, strict=True)]))


@pytest.mark.slow
def test_the_true_markers_lie_on_the_person_where_the_camera_is_and_not_where_it_was(carried):
    last = FRAMES - 1
    assert hits(carried, cameras_at(carried, last), last) >= 0.9
    assert hits(carried, cameras_at(carried, 0), last) <= 0.7


@pytest.mark.slow
def test_the_factors_look_from_where_the_camera_is(carried):
    model = build_model("deutscher_2005", replace(carried, initial_keypoints={}))
    placed = seen_in(model, carried, FRAMES - 1)
    expected = cameras_at(carried, FRAMES - 1)[0].translation_m
    for factor in placed.factors:
        if factor.side == "likelihood":
            np.testing.assert_allclose(np.asarray(factor.log_potential.rig.translation)[0], expected, atol=1e-6)
    observation = model.observe(read_frame(carried, FRAMES - 1))
    log_likelihood = jax.jit(lambda density, state: density.log_likelihood(state, state))
    then, now = (float(log_likelihood(one.density(observation), model.initial)) for one in (model, placed))
    assert then != now
