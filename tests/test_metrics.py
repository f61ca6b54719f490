"""The figures of a run."""

import dataclasses

import jax
import numpy as np
import pytest

from bayes_body.kernels import annealed
from bayes_body.kernels.particle_filter import build_kernel
from bayes_body.metrics import log_evidence, marker_disagreement, silhouette_overlap, summarise
from bayes_body.model import load_model
from bayes_body.posterior import markers, rhat
from bayes_body.tracking import track
from bayes_body.view.silhouette import intersection_over_union


@pytest.fixture(scope="module")
def draws(textured_session):
    return track(textured_session, load_model("arm", textured_session), build_kernel(), jax.random.key(2), particles=50, runs=2)


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
    single = track(textured_session, draws.model, build_kernel(), jax.random.key(0), particles=20)
    summary = summarise(textured_session, single, kernel="sir", seed=0)
    assert summary["rhat_max"] is None and summary["marker_disagreement_mm"] is None
    views = tuple(dataclasses.replace(view, masks=None) for view in textured_session.views)
    blind = summarise(dataclasses.replace(textured_session, views=views), draws, kernel="sir", seed=0)
    assert blind["iou_median"] is None
    assert blind["rhat_max"] > 0.9


def test_evidence_is_averaged_before_the_logarithm_and_null_of_a_mode_seeker(textured_session, draws):
    by_run = np.array([[-3.0, -4.0], [-3.5, -6.0]])
    assert np.isclose(log_evidence(_with_info(draws, log_evidence=by_run)), np.log((np.exp(-7.0) + np.exp(-9.5)) / 2))
    sought = track(textured_session, draws.model, annealed(layers=2), jax.random.key(0), particles=20)
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
    assert np.isclose(summary["log_evidence"], log_evidence(draws))
    assert np.isclose(summary["marker_disagreement_mm"], 1000 * marker_disagreement(draws))
    working = draws.timing.total - draws.timing.compile
    assert np.isclose(summary["evaluations_per_second"], 2 * 5 * 50 / working)
    assert np.isclose(working, sum(frame.seconds for frame in draws.frames))
