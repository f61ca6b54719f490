"""Keypoints of simulated walks: beside the weighted triangulation of Pose2Sim, and in one camera, where a limb may be bent either way."""

import jax
import numpy as np
import pytest
from keypoint_errors import FILTERED, NETWORKS, RAW, SMOOTHED, TRACKED, errors_of
from keypoint_walks import RIG, Network, person_of, shipped_walk, walk_session
from weighted_dlt import filter_points, triangulate_weighted

import bayes_body as bb
from bayes_body.base.files.shipped import definitions_folder
from bayes_body.recording.readers.keypoints.triangulate import project
from bayes_body.recording.readers.rig import read_rig
from bayes_body.results.metrics.accuracy import LEVELS
from bayes_body.results.metrics.truth import Cloud, against_truth

CAMERAS = read_rig(definitions_folder() / "rigs" / f"{RIG}.toml").cameras
POINTS = np.random.default_rng(1).uniform([-0.8, -0.8, 0.2], [0.8, 0.8, 1.8], (20, 3))


def _seen():
    return np.stack([np.column_stack([project(camera, POINTS), np.ones(len(POINTS))]) for camera in CAMERAS])


def test_the_weighted_triangulation_leaves_wrong_cameras_out():
    seen = _seen()
    np.testing.assert_allclose(triangulate_weighted(CAMERAS, seen), POINTS, atol=1e-6)
    seen[0, :10, 0] += 80.0
    seen[1, :5] = np.nan
    np.testing.assert_allclose(triangulate_weighted(CAMERAS, seen), POINTS, atol=1e-6)
    # With all of its weight on two cameras, a third, which is off by less than the threshold, moves nothing.
    seen = _seen()
    seen[2, :, 1] += 10.0
    seen[2, :, 2] = 0.31
    moved = np.linalg.norm(triangulate_weighted(CAMERAS, seen) - POINTS, axis=1)
    seen[2, :, 2] = 1.0
    assert (moved < np.linalg.norm(triangulate_weighted(CAMERAS, seen) - POINTS, axis=1)).all() and (moved > 1e-4).all()
    seen[1:, 0] = np.nan
    assert np.isnan(triangulate_weighted(CAMERAS, seen)[0]).all()


def test_gaps_and_single_outliers_do_not_reach_the_filtered_points():
    slow = np.sin(2 * np.pi * np.arange(120) / 120)[:, None, None] * np.ones(3)
    points = slow.copy()
    points[30:36] = np.nan
    points[60] += 5.0
    np.testing.assert_allclose(filter_points(points, 60.0)[10:-10], slow[10:-10], atol=0.03)


@pytest.mark.long
@pytest.mark.usefixtures("optimised")
def test_against_weighted_triangulation(tmp_path):
    """The table of tests/bench/triangulation.py, in one person: figures of that table leave these bounds far away."""
    person = person_of(shipped_walk(60, 3), True)
    median = {}
    for name in ("clean", "30 % wrong, 10 % missing"):
        session, seen = walk_session(tmp_path / name[:2], person, NETWORKS[name])
        model = bb.load_model("keypoints", session, show=lambda _: None)
        found = errors_of(session, model, seen, person.markers, jax.random.key(0))
        median[name] = {method: 1e3 * np.nanmedian(off) for method, (off, _) in found.items()}
    clean, wrong = median.values()
    assert clean[TRACKED] < 1.1 * clean[RAW] and clean[SMOOTHED] < 1.1 * clean[FILTERED], clean
    assert wrong[TRACKED] < 0.8 * wrong[RAW] and wrong[SMOOTHED] < 0.8 * wrong[FILTERED], wrong


@pytest.mark.long
@pytest.mark.usefixtures("optimised")
def test_in_one_camera_the_intervals_are_those_of_tempered_or_the_run_warns(tmp_path):
    """Frames 10 to 20 of this walk: with `laplace` 76 % of the truth was inside, with `tempered` 95 %."""
    person = person_of(shipped_walk(60, 0), True)
    session, _ = walk_session(tmp_path, person, Network(0.05, 0.1, "assumed", 1), ("C2",))
    model = bb.load_model("keypoints", session, show=lambda _: None)
    tempered, _ = _inside(session, model, model.kernel("tempered"), person.markers)
    # The default is tempered itself, unless someone changes it.
    for kind in sorted({model.kernel().kind, "laplace"} - {"tempered"}):
        inside, sentences = _inside(session, model, model.kernel(kind), person.markers)
        assert abs(inside - tempered) < 0.05 or any("with 1 camera" in sentence for sentence in sentences), (kind, inside, tempered)


def _inside(session, model, kernel, true):
    """The share of the truth inside the 90 % intervals in frames 10 to 20, and the warnings of the run."""
    with pytest.warns(bb.RunWarning):
        draws = bb.track(jax.random.key(1), session, model, kernel, frames=21)
    late = against_truth(model, lambda: (Cloud(frame.states["pose"], frame.log_weights) for frame in draws.frames[10:]), true[10:21])
    return float(late.plain.coverage[LEVELS.index(0.9)]), draws.warnings
