"""Particles and truths that no filter made."""

import dataclasses

import numpy as np
import pytest

from bayes_body.model.build import build_model
from bayes_body.recording.evidence.markers import MARKERS
from bayes_body.results.metrics.clouds import Cloud


@pytest.fixture(scope="module")
def arm(textured_session):
    """A body of three of the fifteen markers."""
    return build_model("arm", textured_session)


@pytest.fixture(scope="module")
def whole(textured_session):
    """A body of all fifteen."""
    return build_model("deutscher_2005", textured_session)


@pytest.fixture
def clouds_of():
    """`clouds_of(poses, log_weights)`: what goes over arrays (frame, run, particle, ...), anew at each call."""

    def call(poses, log_weights=None):
        given = np.zeros(poses.shape[:3]) if log_weights is None else log_weights
        return lambda: (Cloud(*each) for each in zip(poses.astype(np.float32), given, strict=True))

    return call


@pytest.fixture
def all_markers():
    """`all_markers(names, positions)`: (frame, 15, 3) with the others unknown."""

    def call(names, positions):
        truth = np.full((len(positions), len(MARKERS), 3), np.nan)
        truth[:, [MARKERS.index(name) for name in names]] = positions
        return truth

    return call


@pytest.fixture
def with_truth(textured_session, tmp_path, all_markers):
    """`with_truth(names, positions)`: the session of blobs with these true markers."""

    def call(names, positions):
        np.savez(tmp_path / "truth.npz", markers=all_markers(names, positions), names=np.array(MARKERS))
        return dataclasses.replace(textured_session, truth=str(tmp_path / "truth.npz"))

    return call
