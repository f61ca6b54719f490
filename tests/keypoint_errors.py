"""Distances from the truth of markers that are triangulated, filtered and smoothed from the same keypoints."""

import time
from dataclasses import replace

import jax
import numpy as np
from keypoint_walks import Network
from weighted_dlt import filter_points, triangulate_weighted

from bayes_body.kernels.paths.smoother import build_smoother, options_for
from bayes_body.results.metrics import draws_against_truth
from bayes_body.tracking.smooth import smooth
from bayes_body.tracking.track import track

NETWORKS = {"clean": Network(), "5 % wrong, 10 % missing": Network(0.05, 0.1), "30 % wrong, 10 % missing": Network(0.3, 0.1)}
RAW, FILTERED, TRACKED, SMOOTHED = METHODS = ("triangulation", "triangulation, filtered", "`laplace`, filter", "`laplace`, smoothed")


def errors_of(session, model, seen, truth, key, frames=None):
    """By method: distances (frame, marker) from the truth, metres, NaN where a point is missing; and CPU seconds a frame, from the keypoints on."""
    frames = session.frames if frames is None else frames
    begun = time.process_time()
    cameras = [view.camera for view in session.views]
    raw = triangulate_weighted(cameras, seen[:, :frames].reshape(len(cameras), -1, 3)).reshape(frames, -1, 3)
    triangulated = time.process_time()
    filtered = filter_points(raw, session.fps) if frames > 9 else raw
    passed = time.process_time()
    draws = track(key, session, model, frames=frames)
    tracked = time.process_time()
    paths = smooth(session, model, build_smoother(**options_for(draws.kernel, {})), draws.frames, jax.random.fold_in(key, 1), [])
    smoothed = time.process_time()
    off = lambda points: np.linalg.norm(points - truth[:frames], axis=-1)  # noqa: E731
    return {
        RAW: (off(raw), (triangulated - begun) / frames),
        FILTERED: (off(filtered), (passed - begun) / frames),
        TRACKED: (_off(session, draws), (tracked - passed) / frames),
        SMOOTHED: (_off(session, replace(draws, frames=paths)), (smoothed - passed) / frames),
    }


def _off(session, draws):
    return draws_against_truth(session, draws).plain.error[:, 0]
