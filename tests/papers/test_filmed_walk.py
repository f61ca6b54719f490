"""The filmed walk: bent into a circle, and its drift."""

import numpy as np
import pytest
from filmed_walk import bent_into_circle
from image_motion import drift_mm


def test_a_walk_on_a_circle_keeps_distances_and_heights():
    ahead = np.linspace(0, 2.0, 20)
    straight = {
        "pelvis": np.column_stack([ahead, 0 * ahead, 0.9 + 0 * ahead]),
        "head": np.column_stack([ahead + 0.05, 0.02 + 0 * ahead, 1.7 + 0 * ahead]),
    }
    bent = bent_into_circle(straight, 1.5)
    for a, b in ((bent, straight),):
        np.testing.assert_allclose(np.linalg.norm(a["head"] - a["pelvis"], axis=1), np.linalg.norm(b["head"] - b["pelvis"], axis=1), rtol=1e-9)
        np.testing.assert_allclose(a["head"][:, 2], b["head"][:, 2])
    steps = np.diff(bent["pelvis"][:, :2], axis=0)
    turned = np.unwrap(np.arctan2(steps[:, 1], steps[:, 0]))
    np.testing.assert_allclose(np.linalg.norm(steps, axis=1), 2 * 1.5 * np.sin(2.0 / 19 / 1.5 / 2), rtol=1e-9)
    assert turned[-1] - turned[0] == pytest.approx(2.0 / 1.5 * 18 / 19)


def test_the_drift_is_a_slope():
    assert drift_mm(0.05 + 0.001 * np.arange(30)) == pytest.approx(50.0) and drift_mm(np.array([0.1])) == 0
