"""The figures of a run."""

import dataclasses
import json
import tracemalloc

import jax
import numpy as np
import pytest

from bayes_body.base.errors import InputError
from bayes_body.kernels import annealed
from bayes_body.kernels.smc.particle_filter import build_kernel
from bayes_body.model.build import build_model
from bayes_body.recording.session.read import save_session
from bayes_body.results.metrics import draws_against_truth, log_evidence, marker_disagreement, silhouette_overlap, summarise
from bayes_body.results.metrics.by_frame import stack_frames
from bayes_body.results.metrics.calibration import Scores
from bayes_body.results.metrics.figures import NAMES
from bayes_body.results.metrics.fit import intersection_over_union
from bayes_body.results.posterior import markers, mean_poses, rhat
from bayes_body.runs.run import run
from bayes_body.runs.settings import Settings
from bayes_body.tracking.track import track


@pytest.fixture(scope="module")
def draws(textured_session):
    return track(jax.random.key(2), textured_session, build_model("arm", textured_session), build_kernel(), particles=50, runs=2)


def test_intersection_over_union():
    a, b = np.zeros((4, 4), bool), np.zeros((4, 4), bool)
    assert np.isnan(intersection_over_union(a, b))
    a[:2], b[1:3] = True, True
    assert intersection_over_union(a, b) == 4 / 12
    assert intersection_over_union(a, a) == 1


def test_overlap_has_a_figure_for_each_run_frame_and_camera(textured_session, draws):
    overlap = silhouette_overlap(textured_session, draws)
    assert overlap.shape == (2, 5, 2)
    assert ((overlap >= 0) & (overlap <= 1)).all() and overlap.max() > 0


def _with_poses(draws, poses):
    """The draws with other poses (run, frame, particle, dof)."""
    frames = [dataclasses.replace(frame, states={"pose": poses[:, index]}) for index, frame in enumerate(draws.frames)]
    return dataclasses.replace(draws, frames=frames)


def _with_info(draws, **fields):
    """Draws of as many frames as the fields (run, frame) have, with these in their info."""
    frames = []
    for index in range(next(iter(fields.values())).shape[1]):
        info = draws.frames[0].info._replace(**{name: values[:, index] for name, values in fields.items()})
        frames.append(dataclasses.replace(draws.frames[0], info=info))
    return dataclasses.replace(draws, frames=frames)


def test_marker_disagreement_is_a_distance(draws):
    still = np.broadcast_to(draws.states["pose"][:1, :, :1], draws.states["pose"].shape)
    assert marker_disagreement(_with_poses(draws, still)) < 1e-6
    bent = still.copy()
    bent[1, ..., 3] = -0.2
    apart = _with_poses(draws, bent)
    a, b = (markers(draws.model, bent[run, :, 0]) for run in (0, 1))
    assert np.isclose(marker_disagreement(apart), np.linalg.norm(a - b, axis=-1).mean(), rtol=1e-4)


def test_a_figure_that_does_not_exist_is_null(textured_session, draws):
    single = track(jax.random.key(0), textured_session, draws.model, build_kernel(), particles=20)
    summary = summarise(textured_session, single, kernel="sir", seed=0)
    assert summary["rhat_max"] is None and summary["marker_disagreement_mm"] is None
    views = tuple(dataclasses.replace(view, masks=None) for view in textured_session.views)
    blind = summarise(dataclasses.replace(textured_session, views=views), draws, kernel="sir", seed=0)
    assert blind["iou_median"] is None
    assert blind["rhat_max"] > 0.9


def test_evidence_is_averaged_before_the_logarithm_and_null_of_a_mode_seeker(textured_session, draws):
    by_run = np.array([[-3.0, -4.0], [-3.5, -6.0]])
    assert np.isclose(log_evidence(_with_info(draws, log_evidence=by_run)), np.log((np.exp(-7.0) + np.exp(-9.5)) / 2))
    sought = track(jax.random.key(0), textured_session, draws.model, annealed(layers=2), particles=20)
    assert summarise(textured_session, sought, kernel="annealed", seed=0)["log_evidence"] is None


def test_frames_that_a_camera_missed_are_known(draws):
    seen = np.ones((5, 2), bool)
    seen[[0, 2, 3], 1] = False
    frames = [dataclasses.replace(frame, seen=seen[index]) for index, frame in enumerate(draws.frames)]
    made = dataclasses.replace(draws, frames=frames)
    assert made.frames_unseen == {"a": [], "b": [0, 2, 3]}


def test_the_figures_are_those_of_all_frames(textured_session, draws):
    """Computed frame by frame, held against the arrays of all frames."""
    summary = summarise(textured_session, draws, kernel="sir", seed=0)
    ess = np.asarray(draws.info.ess)
    assert summary["ess_min"] == ess.min() and np.isclose(summary["ess_median"], np.median(ess))
    assert np.isclose(summary["rhat_max"], np.nanmax(rhat(draws)))
    assert np.isclose(summary["iou_median"], np.nanmedian(silhouette_overlap(textured_session, draws)))
    # The arm reads silhouettes and edges, and the session has no keypoints.
    assert summary["reads"] == ["edges", "silhouettes"] and summary["reprojection_px_median"] is None
    assert np.isclose(summary["log_evidence"], log_evidence(draws))
    assert np.isclose(summary["marker_disagreement_mm"], 1000 * marker_disagreement(draws))
    working = draws.timing.total - draws.timing.compile
    assert np.isclose(summary["evaluations_per_second"], 2 * 5 * 50 / working)
    assert np.isclose(working, sum(frame.seconds for frame in draws.frames))


def test_without_a_truth_the_error_is_null(textured_session, draws):
    summary = summarise(textured_session, draws, kernel="sir", seed=0)
    assert {name: summary[name] for name in NAMES} == dict.fromkeys(NAMES)


def test_with_a_truth_frame_meets_frame(with_truth, draws):
    """Each frame's truth lies beside the mean markers by so many millimetres as its number says."""
    mean = markers(draws.model, mean_poses(draws)[0]).astype(float)
    beside = mean + np.arange(1, 6)[:, None, None] * [0.0, 0.0, 0.001]
    # Two runs of one posterior: the second is the first.
    frames = [
        dataclasses.replace(frame, states={"pose": frame.states["pose"][[0, 0]]}, log_weights=frame.log_weights[[0, 0]]) for frame in draws.frames
    ]
    for frame in frames:
        frame.states["pose"][:] = np.einsum("rp,rpd->rd", np.exp(frame.log_weights), frame.states["pose"])[:, None]
    still, watched = dataclasses.replace(draws, frames=frames), []
    session = with_truth(draws.model.body.markers.names, beside)
    summary = summarise(session, still, kernel="sir", seed=0, watch=lambda which: (watched.append(len(which)), which)[1])
    assert json.loads(json.dumps(summary, allow_nan=False)) == summary
    assert summary["error_mm_mean"] == pytest.approx(3, abs=0.01) and summary["error_mm_optimistic"] == pytest.approx(3, abs=0.01)
    assert summary["error_mm_std"] == pytest.approx(np.std([1, 2, 3, 4, 5], ddof=1), abs=0.01)
    assert set(summary["error_mm_by_marker"]) == set(draws.model.body.markers.names)
    assert summary["coverage_90"] < 1 and watched == [5, 5]
    # A run of fewer frames meets the first of the truth.
    first = dataclasses.replace(still, frames=frames[:2])
    assert 1000 * draws_against_truth(session, first).plain.frame_error.mean() == pytest.approx(1.5, abs=0.01)


def test_a_mode_seeker_covers_nothing(with_truth, textured_session, draws):
    sought = track(jax.random.key(0), textured_session, draws.model, annealed(layers=2), particles=20)
    summary = summarise(with_truth(draws.model.body.markers.names, np.zeros((5, 3, 3))), sought, kernel="annealed", seed=0)
    assert summary["coverage_50"] is None and summary["coverage_90"] is None and summary["coverage_90_fitted_offset"] is None
    assert summary["error_mm_mean"] > 0


def test_a_truth_that_cannot_be_used_is_told_before_the_tracking(textured_session, tmp_path):
    save_session(dataclasses.replace(textured_session, folder=tmp_path / "session", truth="truth.npz"))
    with pytest.raises(InputError, match=r"truth\.npz: no such file"):
        run(Settings(tmp_path / "session", tmp_path / "run", model="arm"), print, bar=False)
    assert not (tmp_path / "run").exists()


def test_figures_of_many_frames_take_the_memory_of_their_numbers():
    def peak(frames):
        tracemalloc.start()
        stacked = stack_frames(Scores(np.full((2, 15), number), np.zeros((2, 15)), np.zeros((2, 15)), np.zeros(2)) for number in range(frames))
        assert stacked.level.shape == (frames, 2, 15) and stacked.level[:, 1, 3].tolist() == list(range(frames))
        largest = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        return largest

    # Twice for a moment, when the blocks are joined.
    assert peak(2000) - peak(500) < 2.2 * 1500 * (3 * 30 + 2) * 8
