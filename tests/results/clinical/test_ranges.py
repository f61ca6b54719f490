"""Peaks and ranges of motion of paths in closed form: of each draw, within turns and strides, and not where gimbal lock leaves an angle open."""

import numpy as np
import pytest

from bayes_body.results.clinical import paths as path_files
from bayes_body.results.clinical.conventions import ELBOW, SHOULDER
from bayes_body.results.clinical.gait import Gait, Stride, low_pass
from bayes_body.results.clinical.joints import Joint
from bayes_body.results.clinical.paths import IN_MEMORY, StoredPaths, mean_path, sd_path
from bayes_body.results.clinical.ranges import range_figures, ranges_of, stride_ranges
from bayes_body.results.clinical.trajectories import AnglePaths, align, determined

FPS, FRAMES, DRAWS = 50.0, 200, 400


@pytest.fixture(scope="module")
def swings():
    """Draws of a knee that bends once a second; each has its own amplitude, and its own time of the peak."""
    rng = np.random.default_rng(0)
    amplitude, phase = rng.normal(30.0, 3.0, DRAWS), rng.uniform(-0.2, 0.2, DRAWS)
    t = np.arange(FRAMES) / FPS
    knee = 40 + amplitude[:, None] * np.sin(2 * np.pi * (t - phase[:, None]))
    paths = AnglePaths(("knee_flexion", "pelvic_tilt"), ("r", ""), np.stack([knee, np.full_like(knee, 7.0)], axis=-1), np.arange(DRAWS))
    return paths, amplitude


def test_an_interval_is_that_of_the_peaks_and_not_of_the_mean_curve(swings):
    paths, amplitude = swings
    figures = range_figures(ranges_of(paths), {"pelvic_tilt"})
    assert [angle["determined"] for angle in figures.values()] == [True, False]
    assert set(figures) == {"knee_flexion_r", "pelvic_tilt"}
    knee = figures["knee_flexion_r"]
    # 50 frames a swing: a frame lies within 0.2 % of the amplitude from the peak.
    low, high = np.quantile(amplitude, (0.05, 0.95))
    for name, sign, at in (("max_deg", 1, 40), ("min_deg", -1, 40), ("range_deg", 2, 0)):
        assert knee[name]["mean"] == pytest.approx(at + sign * amplitude.mean(), abs=0.15)
        assert knee[name]["q95"] - knee[name]["q05"] == pytest.approx(abs(sign) * (high - low), abs=0.1)
    # The peak of the mean curve is below the mean of the peaks, by more than the interval is wide.
    assert paths.degrees[..., 0].mean(axis=0).max() < 40 + amplitude.mean() - (high - low) / 2
    assert figures["pelvic_tilt"]["range_deg"] == {"mean": 0.0, "sd": 0.0, "q05": 0.0, "q95": 0.0}


def test_a_stride_has_the_angles_of_its_side_and_of_the_middle(swings):
    paths, amplitude = swings
    start, duration = np.full(DRAWS, 0.5), np.full(DRAWS, 1.0)
    start[3] = np.nan
    # The second one lies between frames, and has none.
    strides = (Stride("r", start, duration, duration, duration), Stride("l", start, duration, duration, duration))
    found = stride_ranges(paths, Gait((), (*strides, Stride("r", start + 0.005, np.full(DRAWS, 0.01), duration, duration))), FPS)
    assert [(each.name, each.stride_side, each.stride) for each in found] == [
        ("knee_flexion", "r", 1),
        ("pelvic_tilt", "r", 1),
        ("pelvic_tilt", "l", 1),
        ("knee_flexion", "r", 2),
        ("pelvic_tilt", "r", 2),
    ]
    # A whole swing has both ends, wherever it begins.
    np.testing.assert_allclose(np.delete(found[0].extent, 3), np.delete(2 * amplitude, 3), rtol=5e-3)
    assert np.isnan(found[0].extent[3]) and np.isnan(found[3].extent).all()


def test_whole_turns_do_not_count():
    turning = np.linspace(150, 260, FRAMES)[None, :, None] + np.array([-1.0, 0.0, 1.0])[:, None, None]
    wrapped = (turning + 180) % 360 - 180
    # Draws that begin on another turn.
    found = StoredPaths(wrapped.shape)
    found.write(0, wrapped + 360 * np.array([1, -2, 0])[:, None, None])
    align(found)
    # The mean of the first draw, 204°, is read as -156°.
    np.testing.assert_allclose(list(found), turning - 360, atol=1e-9)


def test_what_gimbal_lock_leaves_open_is_left_out():
    def joint(convention, free=(0, 1, 2)):
        return Joint(convention, "r", -1, 0, np.eye(3), np.eye(3), free)

    angles = np.zeros((FRAMES, 3))
    # The arm hangs, in one frame.
    angles[..., 1] = 40 * np.ones(FRAMES) - 30 * (np.arange(FRAMES) == 7)
    assert determined(joint(SHOULDER), angles) == [1] and determined(joint(ELBOW), angles) == [0, 1, 2]
    angles[..., 1] = 80
    assert determined(joint(SHOULDER), angles) == [0, 1, 2] and determined(joint(ELBOW), angles) == [1]
    # The body holds the second angle fixed.
    assert determined(joint(ELBOW, (0, 2)), angles[..., :2]) == [0, 1]


def test_noise_that_is_faster_than_people_does_not_make_a_peak():
    noise = np.random.default_rng(1).normal(0, 2.0, (DRAWS, FRAMES, 1))
    slow = 30 * np.sin(2 * np.pi * np.arange(FRAMES) / FPS)[None, :, None]
    raw, filtered = ((slow + noise).max(axis=1), low_pass(slow + noise, FPS).max(axis=1))
    assert raw.mean() > 33 and filtered.mean() == pytest.approx(30, abs=1.5)


def test_paths_that_do_not_fit_in_memory_are_the_same_from_a_file(monkeypatch):
    values = np.random.default_rng(2).normal(size=(6, 40, 3))
    stored = []
    for size in (IN_MEMORY, 1000):
        monkeypatch.setattr(path_files, "IN_MEMORY", size)
        stored.append(StoredPaths(values.shape))
        for first in range(0, 40, 16):
            stored[-1].write(first, values[:, first : first + 16])
    for each in stored:
        np.testing.assert_array_equal(list(each), values)
        np.testing.assert_allclose(mean_path(each), values.mean(axis=0), rtol=1e-12)
        np.testing.assert_allclose(sd_path(each), values.std(axis=0), rtol=1e-12)
    # Of the second, nothing was left in memory.
    assert [each._file._rolled for each in stored] == [False, True]
