"""The comparison with few cameras: errors over runs, lost runs, cameras that are left out, and definitions that differ in what is compared alone."""

import numpy as np
import pytest
from error_plot import draw_error_curves
from few_cameras import Followed, few_camera_definitions, with_cameras

from bayes_body.base.errors import InputError
from bayes_body.model.definition import load_definition
from bayes_body.recording.evidence.markers import MARKERS


def _followed(relative, coverage=0.85):
    relative = np.asarray(relative, float)
    return Followed(3 * relative, relative / 2, relative, np.full(len(relative), coverage), 200.0, -9.0, np.array([0.02, 0.04, 0.03]), fps=60.0)


def test_figures_are_means_and_deviations_over_the_runs():
    found = _followed([np.full(60, 0.05), np.full(60, 0.06), np.r_[np.full(20, 0.05), np.full(40, 0.4)]])
    figures = found.figures()
    assert figures["relative_mm"] == {"mean": pytest.approx((50 + 60 + 850 / 3) / 3), "sd": pytest.approx(np.std([50, 60, 850 / 3], ddof=1))}
    assert figures["absolute_mm"]["mean"] == pytest.approx(3 * figures["relative_mm"]["mean"])
    assert figures["lost_runs"] == 1 and figures["coverage_90"] == pytest.approx(0.85)
    assert figures["frames_per_second"] == pytest.approx(1 / 0.03) and figures["evaluations_per_frame"] == 200
    alone = _followed([np.full(60, 0.05)], coverage=np.nan).figures()
    assert alone["coverage_90"] is None and alone["relative_mm"]["sd"] is None


def test_a_run_that_strays_and_comes_back_is_not_lost():
    assert _followed([np.r_[np.full(20, 0.5), np.full(40, 0.05)]]).lost == 0


def test_the_plain_filter_differs_in_its_motion_prior_and_particles_alone():
    for cameras in (1, 2):
        found = few_camera_definitions(cameras)
        guided, plain = found["hmm_apf"], found["apf"]
        assert guided.likelihoods == plain.likelihoods and guided.constraints == plain.constraints and guided.body_name == plain.body_name
        assert (guided.kernel.options.particles, plain.kernel.options.particles) == (40, 200)
        assert guided.kernel.options.layers == plain.kernel.options.layers == 5
        assert guided.likelihoods[0].options.gamma == (5.0 if cameras == 1 else 0.0)
    flat = few_camera_definitions(1, gamma=0.0)
    assert flat["hmm_apf"].likelihoods[0].options.gamma == flat["apf"].likelihoods[0].options.gamma == 0.0
    assert flat["hmm_tempered"] == load_definition("darby_2008_bayes")


def test_a_known_person_has_the_limits_of_their_training():
    found = few_camera_definitions(2, activity="mine.npz", known=True)
    assert [each.kind for each in found["hmm_apf"].constraints] == ["intersection", "training_limits"]
    assert found["hmm_apf"].constraints[1].options.activity == found["hmm_apf"].dynamics.options.activity == "mine.npz"
    # A hard limit has no gradient, which the sampler needs.
    assert [each.kind for each in found["hmm_tempered"].constraints] == ["intersection"]
    assert found["apf"].dynamics.kind == "diffusion"


def test_cameras_are_left_out(session_of_two_cameras):
    one = with_cameras(session_of_two_cameras, 1)
    assert [view.camera.name for view in one.views] == ["left"] and not one.initial_keypoints
    placed, true = np.array([one.initial_markers[name] for name in MARKERS]), np.load(session_of_two_cameras.folder / "truth.npz")["markers"][0]
    assert 0.005 < np.abs(placed - true).mean() < 0.03
    with pytest.raises(InputError, match="cameras: 3; expected 1 to 2, which the session has"):
        with_cameras(session_of_two_cameras, 3)


@pytest.fixture
def session_of_two_cameras(tmp_path):
    from bayes_body.recording.session.session import CameraSpec, Session, View

    cameras = [CameraSpec(name, (64, 48), (60.0, 60.0), (32.0, 24.0), 0.0, (0.0,) * 5, np.eye(3), np.zeros(3)) for name in ("left", "right")]
    keypoints = {camera.name: {"head": (1.0, 2.0, 0.9)} for camera in cameras}
    np.savez(tmp_path / "truth.npz", markers=np.random.default_rng(0).normal(size=(3, len(MARKERS), 3)), names=np.array(MARKERS))
    views = tuple(View(camera, images="%d.png") for camera in cameras)
    return Session(tmp_path, "two", "z", 60.0, 3, 0, views, initial_keypoints=keypoints, truth="truth.npz")


def test_a_picture_has_a_panel_for_each_kind_of_error(tmp_path):
    errors = {"hmm_apf": np.full((3, 20), 0.05), "apf": np.linspace(0.05, 0.3, 60).reshape(3, 20)}
    draw_error_curves(tmp_path / "errors.png", {"absolute": errors, "relative": errors})
    assert (tmp_path / "errors.png").read_bytes().startswith(b"\x89PNG")
