"""Legs that are shorter than the session says, and cameras that are not where it says: with all of it taken as exact, hips and knees bend instead."""

from dataclasses import replace

import jax
import numpy as np
import pytest
from keypoint_walks import Network, shipped_walk
from unknown_figures import dof_scores
from unknown_recordings import MARGIN, OTHER_TABLE, Spread, movement_of, record

import bayes_body as bb
from bayes_body.tracking.track import track

FRAMES, FPS = 6, 60.0
FLEXIONS = ("l_hip_y", "r_hip_y", "l_knee", "r_knee")


@pytest.mark.slow
def test_flexions_are_right_because_lengths_and_cameras_are_unknown(tmp_path):
    movement = movement_of(shipped_walk(FRAMES + 2 * MARGIN, 3), FPS)
    wrong = Spread(bones=0.0, table={**OTHER_TABLE, "thigh": 0.94, "calf": 0.92})
    recording = record(tmp_path, movement, Network(noise="assumed", scale_px=2.0), wrong)
    shipped = bb.load_definition("keypoints")
    scores = {}
    for name, definition in {"taken as exact": replace(shipped, unknowns=()), "shipped": shipped}.items():
        model = bb.load_model(definition, recording.session, show=lambda _: None)
        draws = track(jax.random.key(0), recording.session, model)
        scores[name] = dof_scores(recording.session, draws, FLEXIONS)
    # Standard scores (frame, dof). A shorter leg would be bent by a wrong length in every frame.
    exact, free = (np.sqrt(np.mean(np.square(score), axis=0)) for score in scores.values())
    assert exact.max() > 5 and np.median(exact) > 3, (exact, free)
    assert (np.abs(scores["shipped"]) < 2.5).all(), (exact, free)
