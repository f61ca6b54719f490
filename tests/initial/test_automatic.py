"""First poses of a model's body from the draws of a search: as many of each way to face as the weights say, kept by a run's file."""

import jax.numpy as jnp
import numpy as np
import pytest

from bayes_body.base.errors import InputError
from bayes_body.initial import restored, stored
from bayes_body.initial.fitting.report import FirstPose
from bayes_body.initial.search import automatic
from bayes_body.initial.search.automatic import DRAWS, find_first_pose, fit_to
from bayes_body.initial.search.person_search import Found
from bayes_body.model.build import build_model
from bayes_body.recording.evidence.markers import MARKERS

TURNED, SD_M = 0.25, 0.01


@pytest.fixture(scope="module")
def person(walker):
    return walker(np.random.default_rng(3))


@pytest.fixture(scope="module")
def found(person):
    """Draws of the person's markers with noise, a quarter of which face the other way."""
    true = np.array([person.places[name] for name in MARKERS])
    pelvis = true[MARKERS.index("pelvis")]
    back = pelvis + (true - pelvis) * (-1, -1, 1)
    noise = np.random.default_rng(0).normal(0, SD_M, (80, *true.shape))
    draws = np.where((np.arange(80) < 80 * TURNED)[:, None, None], back, true) + noise
    return Found(MARKERS, true, SD_M, TURNED, TURNED, 60.0, 0.0, draws, np.full(80, 1 / 80), ("no face was found in any view",), {})


@pytest.mark.long
def test_poses_of_both_ways_fit_their_draws_and_come_back_from_the_file(model, scene, person, found):
    told = fit_to(model, scene(1), found)
    assert told.draws is not None and told.draws.shape == (DRAWS, len(model.body.dof_names))
    own = [name for name in model.body.markers.names if name in MARKERS]
    places = np.stack([np.asarray(model.markers(pose)) for pose in told.draws])[:, [model.body.markers.names.index(name) for name in own]]
    left = places[:, own.index("l_hip")] - places[:, own.index("r_hip")]
    turned = left @ (person.places["l_hip"] - person.places["r_hip"]) < 0
    assert turned.sum() == round(DRAWS * TURNED)
    true = np.array([person.places[name] for name in own])
    apart = np.linalg.norm(places - true, axis=2).mean(axis=1)
    assert np.median(apart[~turned]) < 0.04 < 0.1 < apart[turned].min()
    again = restored(model, stored(model, told), "run.toml: first_pose")
    assert again.draws is not None and (again.draws == jnp.asarray(told.draws, again.draws.dtype)).all()
    with pytest.raises(InputError, match=r"run\.toml: first_pose: draws: no poses; expected rows of"):
        restored(model, stored(model, told) | {"draws": [[0.1, 0.2]]}, "run.toml: first_pose")


def test_a_body_with_too_few_of_the_markers_is_a_sentence(textured_session, found):
    arm = build_model("arm", textured_session)
    with pytest.raises(InputError, match=r"the model's body has \d of the markers that are searched for, fewer than 4; .*expected"):
        fit_to(arm, textured_session, found)


def test_what_the_search_is_not_sure_of_is_shown(model, scene, found, monkeypatch):
    class Search:
        def __init__(self, session, seed):
            pass

        def window(self, frame):
            return found._replace(turned=0.25, elsewhere=0.7, ess=3.0)

    lines = []
    monkeypatch.setattr(automatic, "_check_silhouettes", lambda model, session: None)
    monkeypatch.setattr(automatic, "PersonSearch", Search)
    monkeypatch.setattr(automatic, "poses_of", lambda model, *_, **__: FirstPose(model.first_pose, "searched"))
    find_first_pose(model, scene(2), lines.append)
    assert (
        lines[1] == "first pose: no face was found in any view" and "markers are known to 10 mm (root mean square), by 3 effective draws" in lines[2]
    )
    warnings = [line for line in lines if "warning" in line]
    assert len(warnings) == 3 and "face the other way, with a probability of 0.25" in warnings[0] and "probability of 0.45" in warnings[1]


def test_the_same_likelihoods_refine_whatever_tracks(scene):
    """On the body and with the constraints of the model that tracks; a model of keypoints has its own."""
    session = scene(1)
    kinds = {}
    for name in ("deutscher_2005", "sidenbladh_2000_smooth", "keypoints"):
        model = build_model(name, session)
        judges = automatic._judges(model)
        for judge in judges:
            assert judge.body is model.body
            assert [f.name for f in judge.factors if f.side != "likelihood"] == [f.name for f in model.factors if f.side != "likelihood"]
            assert {f.name for f in judge.factors if f.side == "likelihood"} == set(judge.observers)
        kinds[name] = [set(judge.observers) for judge in judges]
    of_pictures = [{"silhouette_edges"}, {"silhouette_edges", "silhouette_bernoulli"}]
    assert kinds == {"deutscher_2005": of_pictures, "sidenbladh_2000_smooth": of_pictures, "keypoints": [{"markers_gaussian"}] * 2}
    (of_judge,) = [f for f in automatic._judges(build_model("deutscher_2005", session))[0].factors if f.side == "likelihood"]
    assert of_judge.log_potential.covers
